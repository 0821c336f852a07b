"""Scans as NumPy archives: the format to convert a log to that nothing else reads.

| key | shape | meaning |
|---|---|---|
| `ranges` | (scans, rays) or (rays,) | [m] |
| `bearings` | as `ranges`, or (rays,) | [rad]; NaN marks padding |
| `angle_min`, `angle_increment` | () | [rad], instead of `bearings` |
| `range_min`; `range_max`, `range_no_return` or `no_return_above` | () | [m] |
| `stamp` or `stamps` | (scans,) | [s] |
| `ray_stamp` | (scans, rays) | time of each ray [s]; NaN marks padding |
| `time_increment` | () | time from ray to ray [s], the stamp being the first's |
| `odometry` or `odom_laser` | (scans, 3) | poses of the lidar by odometry [m, m, rad] |
| `odom_base` or `odom`, and | (scans, 3) | poses of the base by odometry |
| `laser_in_base` | (3,) | pose of the lidar in the base |

Only `ranges` and their directions are needed. Where the file has `ray_stamp` and no
stamps, a scan is stamped with its last ray. The first key of odometry in this order
counts; poses of the base without `laser_in_base` are taken as the lidar's.
"""

import zipfile
from pathlib import Path

import numpy as np

from fsmsm_jax.io.frames import compose
from fsmsm_jax.io.logs import ScanLog

__all__ = ["read_npz"]

_RANGE_MAX = 30.0  # [m] where a file states no limit, as in `Scan.from_ranges`
_NO_ECHO_KEYS = ("range_max", "range_no_return", "no_return_above")
_ODOMETRY_KEYS = ("odometry", "odom_laser", "odom_base", "odom")
_KEYS = (
    *("ranges", "bearings", "angle_min", "angle_increment", "range_min"),
    *("stamp", "stamps", "ray_stamp", "time_increment", "laser_in_base"),
    *_NO_ECHO_KEYS,
    *_ODOMETRY_KEYS,
)


def read_npz(path: Path) -> ScanLog:
    """One scan or many, with all that the file says of the sensor and its way.

    Raises:
        ValueError: the file is no archive, has no `ranges` or directions, or an array
            is of the wrong shape or kind.
    """
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
    stamps, ray_times = _times(path, data, stamps, ranges.shape)
    odometry, remarks = _odometry(path, data, len(ranges))
    ranges, bearings = _without_padding(ranges, _bearings(path, data, ranges.shape))
    return ScanLog(
        ranges=ranges,
        bearings=bearings,
        range_min=_number(path, "range_min", data.get("range_min", 0.0)),
        range_max=min(limits, default=_RANGE_MAX),
        stamps=stamps,
        odometry=odometry,
        ray_times=ray_times,
        remarks=remarks,
    )


def _times(
    path: Path,
    data: dict[str, np.ndarray],
    stamps: np.ndarray | None,
    shape: tuple[int, ...],
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Stamps of the scans and times of the rays after them, as far as known [s]."""
    if "ray_stamp" in data:
        rays = np.atleast_2d(_numbers(path, "ray_stamp", data["ray_stamp"]))
        known = np.isfinite(rays)
        if rays.shape != shape or not known.any(axis=1).all():
            raise ValueError(
                f"`ray_stamp` of {path.name} must have shape {shape} as `ranges` has, "
                f"with a time in each scan; it has shape {rays.shape}"
            )
        if stamps is None:
            stamps = np.asarray(np.max(rays, axis=1, initial=-np.inf, where=known))
        after = rays - stamps[:, None]
        return stamps, np.where(known, after, 0.0)
    step = _number(path, "time_increment", data.get("time_increment", 0.0))
    if step == 0:
        return stamps, None
    return stamps, np.broadcast_to(step * np.arange(shape[1]), shape)


def _odometry(
    path: Path, data: dict[str, np.ndarray], scans: int
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Poses of the lidar (scans, 3) by odometry, NaN where they are not known."""
    key = next((key for key in _ODOMETRY_KEYS if key in data), None)
    if key is None:
        return None, ()
    poses = np.atleast_2d(_numbers(path, key, data[key]))
    if poses.shape != (scans, 3):
        raise ValueError(
            f"`{key}` of {path.name} must hold a pose [x, y, θ] a scan, shape "
            f"({scans}, 3), it has {data[key].shape}"
        )
    poses = np.where(np.isfinite(poses).all(axis=1, keepdims=True), poses, np.nan)
    if key in ("odometry", "odom_laser"):
        return poses, ()
    if "laser_in_base" not in data:
        return poses, (
            f"the file has no `laser_in_base`: `{key}` is taken as the lidar's",
        )
    mounting = _numbers(path, "laser_in_base", data["laser_in_base"])
    if mounting.shape != (3,) or not np.isfinite(mounting).all():
        raise ValueError(
            f"`laser_in_base` of {path.name} must be one finite pose [x, y, θ], "
            f"not {mounting}"
        )
    return compose(poses, mounting), ()


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
