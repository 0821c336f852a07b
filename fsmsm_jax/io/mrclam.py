"""UTIAS MRCLAM: robots that drive among barcodes, watched by motion capture.

Each robot reports the speed and turn rate it was told, and its camera the barcodes it
reads: which, how far, and where to. Barcodes belong to subjects, of which the first
five are robots; sightings of those are dropped, the others are landmarks, numbered in
the order of Landmark_Groundtruth.dat. So association is known, and so is the truth.

Some copies keep five digits of each time, so that after 1 000 s five rows share one:
where rows come at an even rate that agrees with all times, they get that rate back.
The looks' times stay rounded, to ±0.05 s.

The truth errs, too. Averaging at half a turn left single headings that point anywhere;
they are NaN here. And for minutes motion capture held the robot for turned by 120°
(robot 3 of set 9: 757 to 830 s and 990 to 1 060 s), which nothing tells but the
sightings.

There is no published noise. Robot 3 of set 9 against its truth: ranges 0.12 m,
bearings 0.026 rad (and all 0.02 rad to the right), view ±31° to 7.6 m; in a second the
way is wrong by 0.016 m and the turn by 0.09 rad, of which much is no noise: it turns
by two thirds of what it is told.

Reference: K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative
localization and mapping dataset", IJRR 30(8), 2011.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fsmsm_jax.io.landmarks import LandmarkLog, cut_at_looks
from fsmsm_jax.io.tables import read_table
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import DiffDrive

__all__ = ["read_mrclam"]

_FASTEST_TURN = 10.0  # [rad/s]: no robot turns like that, they reach 1
_ROUNDED_BY = 0.051  # [s]
_LONGEST_STEP = 0.5  # [s]


def read_mrclam(folder: str | Path, robot: int | None = None) -> LandmarkLog:
    """What one robot did and saw, and where it truly was.

    Args:
        folder: with Barcodes.dat, Landmark_Groundtruth.dat and, of the robot,
            Robot3_Odometry.dat, Robot3_Measurement.dat and Robot3_Groundtruth.dat.
        robot: its number; needed only where there are several.

    Returns:
        The log. Looks before odometry and truth begin are left out. The camera is
        silent when it sees nothing; its gaps are filled with looks that found nothing,
        so that no step lasts longer than 0.5 s (and none is hundreds of controls wide).

    Raises:
        ValueError: files are missing or torn, a barcode belongs to nobody, or there
            are several robots and `robot` names none of them.
    """
    folder = Path(folder)
    name = f"Robot{_which(folder, robot)}"
    subjects = read_table(folder / "Barcodes.dat", 2).astype(int)
    survey = read_table(folder / "Landmark_Groundtruth.dat", 3)
    controls = _evenly(read_table(folder / f"{name}_Odometry.dat", 3))
    seen = read_table(folder / f"{name}_Measurement.dat", 4)
    seen = seen[np.isfinite(seen[:, :2]).all(axis=1)]
    truth = _evenly(read_table(folder / f"{name}_Groundtruth.dat", 4))
    truth = truth[np.isfinite(truth).all(axis=1)]
    truth = truth[np.argsort(truth[:, 0], kind="stable")]
    if len(truth) == 0:
        raise ValueError(f"{name}_Groundtruth.dat holds no finite pose")

    subject_of = {code: subject for subject, code in subjects}
    unknown = sorted({int(code) for code in seen[:, 1]} - subject_of.keys())
    if unknown:
        raise ValueError(f"barcodes {unknown} of {name} are not in Barcodes.dat")
    landmark_of = {int(subject): i for i, subject in enumerate(survey[:, 0])}
    ids = np.array([landmark_of.get(subject_of[int(c)], -1) for c in seen[:, 1]])
    usable = (ids >= 0) & (seen[:, 0] >= max(controls[0, 0], truth[0, 0]))
    if not usable.any():
        raise ValueError(f"{name} saw no landmark of the survey: check the times")
    seen, ids = seen[usable], ids[usable]
    looks = _without_gaps(np.unique(seen[:, 0]))
    found = np.column_stack([np.searchsorted(looks, seen[:, 0]), seen[:, 2:]])
    drive, times, remarks = cut_at_looks(controls, looks, found, ids)

    headings = _believed(truth)
    good = np.isfinite(headings)
    turned = np.interp(times[0], truth[good, 0], np.unwrap(headings[good]))
    start = [np.interp(times[0], truth[:, 0], truth[:, i]) for i in (1, 2)]
    before = truth[:, 0] <= times[-1]
    return LandmarkLog(
        drive,
        times,
        np.array([*start, turned]),
        DiffDrive(noise=(0.1, 0.6)),
        RangeBearing(noise=(0.12, 0.03), reach=8.0, half_view=0.55),
        truth[before, :3],
        headings[before],
        survey[:, 1:],
        remarks,
    )


def _which(folder: Path, robot: int | None) -> int:
    """The robot's number, checked against what there is."""
    found = [
        int(match[1])
        for file in folder.glob("Robot*_Odometry.dat")
        if (match := re.fullmatch(r"Robot(\d+)_Odometry\.dat", file.name))
    ]
    if robot in found or (robot is None and len(found) == 1):
        return found[0] if robot is None else robot
    raise ValueError(
        f"expected the number of one robot of {folder}, got {robot}; there are "
        f"{sorted(found) or 'none'}"
    )


def _without_gaps(
    looks: Float[np.ndarray, "looks"],
) -> Float[np.ndarray, "more"]:
    """The looks, and evenly between them such as found nothing."""
    pieces = np.maximum(1, np.ceil(np.diff(looks) / _LONGEST_STEP)).astype(int)
    filled = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(looks[:-1], looks[1:], pieces, strict=True)
    ]
    return np.concatenate([*filled, looks[-1:]])


def _evenly(table: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows n"]:
    """The same rows, at an even rate if all their rounded times allow it."""
    times = table[:, 0]
    if len(times) < 3:
        return table
    step = np.median(np.diff(times[: np.searchsorted(times, times[0] + 60.0)]))
    even = times[0] + step * np.arange(len(times))
    if np.isfinite(step) and np.all(np.abs(even - times) < _ROUNDED_BY):
        return np.column_stack([even, table[:, 1:]])
    return table


def _believed(truth: Float[np.ndarray, "rows 4"]) -> Float[np.ndarray, "rows"]:
    """Headings [rad], NaN where the robot would have spun to get there."""
    turns = np.diff(truth[:, 3])
    turns = np.abs(np.arctan2(np.sin(turns), np.cos(turns)))
    spun = turns > _FASTEST_TURN * np.maximum(np.diff(truth[:, 0]), 1e-3)
    edges = np.concatenate([[False], spun, [False]])
    return np.where(edges[:-1] | edges[1:], np.nan, truth[:, 3])
