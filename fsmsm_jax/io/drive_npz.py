"""Drives as NumPy archives: what to convert a landmark log of one's own to.

| key | shape | meaning |
|---|---|---|
| `controls` | (steps, controls, 3) | [m/s], [rad] or [rad/s], how long [s] |
| `detections` | (steps, detections, 2) | range [m], bearing [rad], 0 ahead, left + |
| `times` | (steps,) | of the looks [s] |
| `valid` | (steps, detections) | which detections there are; all, if missing |
| `ids` | (steps, detections) | which landmark, from 0; −1, or missing: unknown |
| `start` | (3,) | pose at the first look [m, m, rad]; zero if missing |
| `wheel_base` | () | [m]: it is a car; without, it turns by its turn rate |
| `wheel_offset`, `front_wheel` | (), () | see `slam.vehicle.Car` |
| `tracked`, `trim` | (2,), (2,) | likewise |
| `control_noise` | (2,) | σ of speed and steering or turn rate, each control |
| `detection_noise` | (2,) | σ of range [m] and bearing [rad] |
| `reach`, `half_view` | () | of the sensor [m], [rad] |
| `reference` | (fixes, 3) | time [s], place [m, m] |
| `headings` | (fixes,) | [rad] |
| `landmarks` | (landmarks, 2) | [m], in the order of `ids` |

The first three are needed. Step 0 is the look at the start; the controls of step k lead
from look k − 1 to look k, and rows that last 0 s are padding (`io.landmarks.
cut_at_looks` makes such steps of raw streams). Nothing is unpickled: an archive with
objects in it is refused.
"""

import zipfile
from pathlib import Path

import numpy as np

from fsmsm_jax.io.landmarks import LandmarkLog
from fsmsm_jax.slam.drive import tidied
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Car, DiffDrive, Vehicle

__all__ = ["read_drive_npz", "write_drive_npz"]

_NEEDED = ("controls", "detections", "times")


def write_drive_npz(path: str | Path, log: LandmarkLog) -> None:
    """Write a log so that `read_drive_npz` gives it back, but for its remarks.

    Args:
        path: the file, replaced if it exists; `.npz` is appended where it lacks.
        log: one drive.
    """
    drive, sensor, vehicle = log.drive, log.sensor, log.vehicle
    arrays = {
        "controls": drive.controls,
        "detections": drive.detections,
        "valid": drive.valid,
        "ids": drive.ids,
        "times": log.times,
        "start": log.start,
        "control_noise": vehicle.noise,
        "detection_noise": sensor.noise,
        "reach": sensor.reach,
        "half_view": sensor.half_view,
        "reference": log.reference,
        "headings": log.headings,
        "landmarks": log.landmarks,
    }
    if isinstance(vehicle, Car):
        arrays["wheel_base"] = vehicle.wheel_base
        arrays["wheel_offset"] = vehicle.wheel_offset
        arrays["tracked"] = vehicle.tracked
        arrays["trim"] = vehicle.trim
        arrays["front_wheel"] = vehicle.front_wheel
    kept = {key: np.asarray(a) for key, a in arrays.items() if a is not None}
    np.savez_compressed(path, allow_pickle=False, **kept)


def read_drive_npz(path: str | Path) -> LandmarkLog:
    """A drive with all that the file says of vehicle, sensor and truth.

    Raises:
        ValueError: the file is missing or no archive of plain arrays, an array is
            missing or of the wrong shape or kind, or times go back.
    """
    path = Path(path)
    data = _arrays(path)
    missing = [key for key in _NEEDED if key not in data]
    if missing:
        raise ValueError(
            f"{path.name} lacks {missing}: expected {list(_NEEDED)}, found "
            f"{sorted(data)}"
        )
    steps, looks = data["times"].shape[:1], data["detections"].shape[:2]
    shapes = {"controls": (*steps, "controls", 3), "times": steps, "start": (3,)}
    shapes |= {"detections": (*steps, "detections", 2), "valid": looks, "ids": looks}
    shapes |= {"reference": ("fixes", 3), "landmarks": ("landmarks", 2)}
    shapes |= {"headings": (len(data.get("reference", ())),)}
    for key, shape in shapes.items():
        if key in data and not _fits(data[key].shape, shape):
            raise ValueError(
                f"`{key}` of {path.name} must have shape {shape}, not {data[key].shape}"
            )
    times = data["times"]
    if len(times) == 0 or not np.isfinite(times).all() or np.any(np.diff(times) < 0):
        raise ValueError(
            f"`times` of {path.name} must be finite, at least one, and not go back: "
            "sort the looks and cut the controls at them (io.landmarks.cut_at_looks)"
        )
    start = data.get("start", np.zeros(3))
    if not np.isfinite(start).all():
        raise ValueError(f"`start` of {path.name} must be a finite pose, not {start}")
    for key in ("valid", "ids"):
        if key in data and not np.isfinite(data[key]).all():
            raise ValueError(f"`{key}` of {path.name} must be finite: write -1 or 0")
    ids = data.get("ids")
    try:
        drive = tidied(
            data["controls"],
            data["detections"],
            data.get("valid"),
            None if ids is None else ids.astype(int),
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error
    return LandmarkLog(
        drive,
        times,
        start,
        _vehicle(path, data),
        _sensor(path, data),
        data.get("reference", np.zeros((0, 3))),
        data.get("headings"),
        data.get("landmarks"),
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of the archive, in float64."""
    try:
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it holds one unnamed array")
            found = {key: archive[key] for key in archive.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path.name} is no readable .npz archive: {error}") from error
    for key, array in found.items():
        if array.dtype.kind not in "biuf":
            raise ValueError(
                f"`{key}` of {path.name} must hold real numbers, not {array.dtype}"
            )
    return {key: array.astype(float) for key, array in found.items()}


def _fits(shape: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        isinstance(b, str) or a == b for a, b in zip(shape, wanted, strict=True)
    )


def _numbers(
    path: Path, data: dict[str, np.ndarray], key: str, default: object
) -> np.ndarray:
    """A setting of the default's shape, finite."""
    usual = np.asarray(default, float)
    value = data.get(key, usual)
    if value.shape != usual.shape or not np.isfinite(value).all():
        raise ValueError(
            f"`{key}` of {path.name} must be finite, of shape {usual.shape}, "
            f"not {value}"
        )
    return value


def _pair(
    path: Path, data: dict[str, np.ndarray], key: str, default: object
) -> tuple[float, float]:
    first, second = _numbers(path, data, key, default)
    return float(first), float(second)


def _vehicle(path: Path, data: dict[str, np.ndarray]) -> Vehicle:
    if "wheel_base" not in data:
        return DiffDrive(_pair(path, data, "control_noise", DiffDrive().noise))
    usual = Car()
    wheel_base = float(_numbers(path, data, "wheel_base", usual.wheel_base))
    if wheel_base <= 0:
        raise ValueError(
            f"`wheel_base` of {path.name} must be above 0, not {wheel_base}"
        )
    return Car(
        wheel_base,
        float(_numbers(path, data, "wheel_offset", usual.wheel_offset)),
        _pair(path, data, "tracked", usual.tracked),
        _pair(path, data, "control_noise", usual.noise),
        _pair(path, data, "trim", usual.trim),
        front_wheel=bool(_numbers(path, data, "front_wheel", usual.front_wheel)),
    )


def _sensor(path: Path, data: dict[str, np.ndarray]) -> RangeBearing:
    usual = RangeBearing()
    noise = _pair(path, data, "detection_noise", usual.noise)
    if min(noise) <= 0:
        raise ValueError(
            f"`detection_noise` of {path.name} must be above 0, not {noise}"
        )
    return RangeBearing(
        noise,
        float(_numbers(path, data, "reach", usual.reach)),
        float(_numbers(path, data, "half_view", usual.half_view)),
    )
