"""Recorded scans: one reader for every kind of log.

A lidar log is a list of turns, each a row of ranges. Whatever the file, the result is
one `ScanLog` of NumPy arrays, still as dirty as the sensor was; `log.scan(i)` turns
row i into a `Scan`, where the dirt is sorted out (see `sensing.lidar`). Poses that a
file may carry, odometry or reference, are left alone: this is the lidar's view only,
and a pose found from it is the pose of the *lidar*, not of the robot's base.

- `.npz`: `ranges` and either `bearings` or `angle_min` and `angle_increment`;
- CARMEN `.log`, `.log.gz`, `.clf`: see `io.carmen`;
- ROS 1 `.bag`, ROS 2 folders, `.db3` and `.mcap`: see `io.rosbag`.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fsmsm_jax.sensing.lidar import Scan

__all__ = ["ScanLog", "read_scans"]

_RANGE_MAX = 30.0  # [m] where a file states no limit, as in `Scan.from_ranges`
_NO_ECHO_KEYS = ("range_max", "range_no_return", "no_return_above")
_RAY_KEYS = ("ranges", "bearings", "angle_min", "angle_increment")
_KEYS = (*_RAY_KEYS, "range_min", *_NO_ECHO_KEYS, "stamp", "stamps")
_SUPPORTED = (
    "an .npz with ranges, angle_min and angle_increment (or bearings), a CARMEN log "
    "(.log, .clf, also .gz), a ROS 1 .bag, or a ROS 2 bag (folder, .db3 or .mcap)"
)


@dataclass(frozen=True)
class ScanLog:
    """Scans in the order in which they were recorded; `len(log)` of them."""

    ranges: Float[np.ndarray, "scans rays"]
    """Raw readings [m], no-echo codes and NaN included; NaN pads short scans."""
    bearings: Float[np.ndarray, "scans rays"]
    """Directions in the sensor frame [rad], counter-clockwise."""
    range_min: float
    """Smallest range that counts [m]."""
    range_max: float
    """From this range on a reading means "no echo" [m]."""
    stamps: Float[np.ndarray, "scans"] | None
    """Recording times [s], or None where the file has none."""

    def __len__(self) -> int:
        return len(self.ranges)

    def scan(self, index: int) -> Scan:
        """The scan at `index`, counted from 0, or from the end if negative.

        Raises:
            ValueError: the log has no such scan, or it holds no information.
        """
        if not -len(self) <= index < len(self):
            raise ValueError(
                f"the log holds scans 0 to {len(self) - 1}, there is no scan {index}"
            )
        try:
            return Scan.from_bearings(
                self.ranges[index], self.bearings[index], self.range_min, self.range_max
            )
        except ValueError as error:
            raise ValueError(f"scan {index} of the log: {error}") from error


def read_scans(path: str | Path, topic: str | None = None) -> ScanLog:
    """All scans of a log file, whatever its format.

    Args:
        path: the log; the module's docstring lists the formats.
        topic: which `LaserScan` topic of a rosbag to read; needed only where it has
            several.

    Raises:
        ValueError: the file is missing, of no supported format, truncated, or holds
            no scans; a rosbag has several scan topics and `topic` names none of them.
        ImportError: the log is a rosbag and the `rosbags` package is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"there is no log at {path}")
    kind = path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix
    if path.is_dir() or kind in (".bag", ".db3", ".mcap"):
        from fsmsm_jax.io.rosbag import read_rosbag

        return read_rosbag(path, topic)
    if topic is not None:
        raise ValueError(
            f"only rosbags have topics, {path.name} is none; drop the topic"
        )
    if kind == ".npz":
        return _read_npz(path)
    if kind in (".log", ".clf"):
        from fsmsm_jax.io.carmen import read_carmen

        return read_carmen(path)
    raise ValueError(f"cannot read {path.name}: expected {_SUPPORTED}")


def _read_npz(path: Path) -> ScanLog:
    """One scan (rays,) or many (scans, rays), with what the file says of the sensor."""
    try:
        with path.open("rb") as file:
            archive = np.load(file)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it holds one unnamed array")
            found = sorted(archive.files)
            data = {key: archive[key] for key in found if key in _KEYS}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path.name} is no readable .npz archive: {error}") from error

    if "ranges" not in data:
        raise ValueError(f"{path.name} needs an array `ranges`, it has {found}")
    ranges = _numbers(path, "ranges", data["ranges"])
    if ranges.ndim not in (1, 2) or ranges.size == 0:
        raise ValueError(
            f"`ranges` of {path.name} must be a non-empty (rays,) or (scans, rays) "
            f"array, it has shape {ranges.shape}"
        )
    ranges = np.atleast_2d(ranges)
    limits = [_number(path, key, data[key]) for key in _NO_ECHO_KEYS if key in data]
    stamps = data.get("stamp", data.get("stamps"))
    if stamps is not None:
        stamps = _numbers(path, "stamp", np.atleast_1d(stamps))
        if stamps.shape != ranges.shape[:1]:
            raise ValueError(
                f"{path.name} has {len(ranges)} scans but {stamps.shape} stamps"
            )
    ranges, bearings = _without_padding(ranges, _bearings(path, data, ranges.shape))
    return ScanLog(
        ranges=ranges,
        bearings=bearings,
        range_min=_number(path, "range_min", data.get("range_min", 0.0)),
        range_max=min(limits, default=_RANGE_MAX),
        stamps=stamps,
    )


def _bearings(
    path: Path, data: dict[str, np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    """`bearings` as given, or from the first angle and the step."""
    if "bearings" in data:
        bearings = _numbers(path, "bearings", data["bearings"])
        if bearings.shape not in (shape, shape[1:]):
            raise ValueError(
                f"`bearings` of {path.name} must have shape {shape[1:]} or {shape} as "
                f"`ranges` has, not {bearings.shape}"
            )
    elif {"angle_min", "angle_increment"} <= data.keys():
        first = _number(path, "angle_min", data["angle_min"])
        step = _number(path, "angle_increment", data["angle_increment"])
        bearings = first + step * np.arange(shape[1])
    else:
        raise ValueError(
            f"{path.name} does not say where its rays point: add `angle_min` and "
            "`angle_increment` [rad], or `bearings` [rad]"
        )
    return np.broadcast_to(bearings, shape)


def _without_padding(
    ranges: np.ndarray, bearings: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Rays without a direction are padding: NaN their range, give them a bearing."""
    padding = np.isnan(bearings)
    return np.where(padding, np.nan, ranges), np.where(padding, 0.0, bearings)


def _numbers(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    if not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values):
        raise ValueError(
            f"`{name}` of {path.name} must hold numbers, not {values.dtype}"
        )
    return values.astype(float)


def _number(path: Path, name: str, value: np.ndarray | float) -> float:
    array = _numbers(path, name, np.asarray(value))
    if array.size != 1 or not np.isfinite(array).all():
        raise ValueError(
            f"`{name}` of {path.name} must be one finite number, not {value}"
        )
    return float(array.reshape(()))
