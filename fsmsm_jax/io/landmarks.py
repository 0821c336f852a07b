"""Logs for SLAM with landmarks: one record, whatever the file.

Such a log holds controls (wheel speed and steering, forty a second), looks of a laser
or camera (five a second) and what each look found. The clocks do not tick together, so
a `Drive` is *cut*: a step lasts from one look to the next, and the controls in force in
between are cut exactly at the looks' times, each holding until the next came. Thus the
durations of a step add up to the time between its looks, and nothing is interpolated.
The first look is where the drive starts: its step moves nothing.

- the ACFR's utility car in the car park and in Victoria Park: see `io.acfr`;
- UTIAS MRCLAM, robots that drive among barcodes: see `io.mrclam`;
- `.npz` with a drive that is cut already, for logs of one's own: see `io.drive_npz`.

`reference` is where the vehicle was by GPS or motion capture, to compare with; it is
the tracked point's place, of which the filters estimate the pose.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from fsmsm_jax.slam.drive import Drive, tidied
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Vehicle

__all__ = ["LandmarkLog", "cut_at_looks", "read_landmark_log"]

_SUPPORTED = (
    "a folder with data_set.mat or odometry.csv, detections.csv and gps.csv (car "
    "park), with VictoriaParkSinSincronizar.mat, or with Robot*_Odometry.dat (MRCLAM), "
    "or an .npz with controls, detections and times"
)


class LandmarkLog(NamedTuple):
    """One recorded drive, all NumPy arrays in float64."""

    drive: Drive
    """One step a look; the first holds the look at the start and moves nothing."""
    times: Float[np.ndarray, "steps"]
    """Of the looks [s], by the log's clock, not decreasing."""
    start: Float[np.ndarray, "3"]
    """Pose of the tracked point at the first look [m, m, rad]."""
    vehicle: Vehicle
    """How it moves, with published noise where there is any."""
    sensor: RangeBearing
    """What finds the landmarks, with published noise where there is any."""
    reference: Float[np.ndarray, "fixes 3"]
    """Time [s] and place [m, m] of the tracked point by other means; may be empty."""
    headings: Float[np.ndarray, "fixes"] | None = None
    """True heading at each fix [rad], NaN where it is not to be believed."""
    landmarks: Float[np.ndarray, "landmarks 2"] | None = None
    """Surveyed places [m], in the order of the drive's ids."""
    remarks: tuple[str, ...] = ()
    """What was mended while reading, in sentences for the user."""


def cut_at_looks(
    controls: Shaped[np.ndarray, "controls 3"],
    looks: Shaped[np.ndarray, "steps"],
    found: Shaped[np.ndarray, "detections 3"],
    ids: Int[np.ndarray, "detections"] | None = None,
) -> tuple[Drive, Float[np.ndarray, "steps"], tuple[str, ...]]:
    """Cut a stream of controls at the looks' times, and sort detections to looks.

    Args:
        controls: time [s], speed [m/s] and steering [rad] (or turn rate [rad/s]); each
            holds until the next. Before the first, the vehicle stands.
        looks: their times [s], a look that found nothing among them.
        found: which look it was, range [m] and bearing [rad] of each detection.
        ids: which landmark each is, by default unknown (−1).

    Returns:
        The drive, padded no wider than its busiest step; the times of its steps; what
        was mended.

    Raises:
        ValueError: there are no controls or no looks, or a look has no time.
    """
    controls, looks = np.asarray(controls, float), np.asarray(looks, float)
    timed = controls[np.isfinite(controls[:, 0])]
    if len(timed) == 0 or len(looks) == 0:
        raise ValueError(
            f"expected controls and looks with times, got {len(timed)} and {len(looks)}"
        )
    if not np.isfinite(looks).all():
        raise ValueError(f"{np.sum(~np.isfinite(looks))} looks have no finite time")
    remarks = _remarks(controls, looks)
    timed = timed[np.argsort(timed[:, 0], kind="stable")]
    order = np.argsort(looks, kind="stable")
    times, step_of_look = looks[order], np.argsort(order, kind="stable")

    inside = (timed[:, 0] > times[0]) & (timed[:, 0] < times[-1])
    borders = np.sort(np.concatenate([timed[inside, 0], times]))
    begins, lasting = borders[:-1], np.diff(borders)
    begins, lasting = begins[lasting > 0], lasting[lasting > 0]
    held = np.searchsorted(timed[:, 0], begins, side="right")
    standing = np.vstack([np.zeros(3), timed])
    rows = np.column_stack([standing[held, 1:], lasting])
    moving, _ = _stacked(
        np.searchsorted(times, begins, side="right"), rows, len(times), 0.0
    )

    found = np.asarray(found, float).reshape(-1, 3)
    ids = np.full(len(found), -1) if ids is None else np.asarray(ids)
    steps = step_of_look[found[:, 0].astype(int)]
    seen, valid = _stacked(
        steps, np.column_stack([found[:, 1:], ids]), len(times), -1.0
    )
    drive = tidied(moving, seen[..., :2], valid, seen[..., 2].astype(int))
    return drive, times, remarks


def _stacked(
    step: np.ndarray, rows: np.ndarray, steps: int, fill: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows side by side in their steps, and where there are any."""
    order = np.argsort(step, kind="stable")
    step, rows = step[order], rows[order]
    counts = np.bincount(step, minlength=steps)
    place = np.arange(len(step)) - (np.cumsum(counts) - counts)[step]
    shape = (steps, max(1, counts.max()))
    stacked = np.full((*shape, rows.shape[1]), fill)
    stacked[step, place] = rows
    return stacked, np.arange(shape[1])[None, :] < counts[:, None]


def _remarks(controls: np.ndarray, looks: np.ndarray) -> tuple[str, ...]:
    """What is odd about the times and the controls."""
    said = []
    for name, times in (("controls", controls[:, 0]), ("looks", looks)):
        if back := np.sum(np.diff(times) < 0):
            said.append(
                f"the times of the {name} go back {back} times: they were sorted"
            )
    if lost := np.sum(~np.isfinite(controls[:, 0])):
        said.append(f"{lost} controls have no time and were left out")
    if bad := np.sum(~np.isfinite(controls[:, 1:]).all(axis=1)):
        said.append(f"{bad} controls are not finite: those before them were held")
    return tuple(said)


def read_landmark_log(path: str | Path) -> LandmarkLog:
    """A log for SLAM with landmarks, told by what there is.

    Args:
        path: a folder or a file; the module's docstring lists the kinds. A file of a
            folder that belongs together stands for the folder.

    Raises:
        ValueError: nothing is there, it is none of the kinds, or it cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"there is no log at {path}: expected {_SUPPORTED}")
    if path.suffix == ".npz":
        from fsmsm_jax.io.drive_npz import read_drive_npz

        return read_drive_npz(path)
    folder = path if path.is_dir() else path.parent
    names = {file.name for file in folder.iterdir()}
    if "VictoriaParkSinSincronizar.mat" in names:
        from fsmsm_jax.io.acfr import read_victoria_park

        return read_victoria_park(folder)
    if "data_set.mat" in names or {"odometry.csv", "gps.csv"} <= names:
        from fsmsm_jax.io.acfr import read_carpark

        return read_carpark(folder)
    if any(folder.glob("Robot*_Odometry.dat")):
        from fsmsm_jax.io.mrclam import read_mrclam

        return read_mrclam(folder)
    raise ValueError(
        f"cannot tell what {path} is: expected {_SUPPORTED}; found "
        f"{sorted(names)[:8] or 'nothing'}"
    )
