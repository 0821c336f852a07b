"""Are the covariances honest? NEES in simulation and on real scans.

e is the error of a match, C the covariance it reports; eᵀ C⁻¹ e averages 3 if C is
honest. Matches in a wrong basin (0.3 m or 5° off) are counted apart and left out: a
covariance speaks of one valley only.

In simulation (the thesis's polygon worlds, Gaussian noise) the truth is known, and the
fit starts 3 cm and 1.7° beside it. Real scans are ones that the map was not made of,
matched from 0.2 m and 0.2 rad beside their references. Those have errors of their own.
Against a third opinion, a fit of each scan to the scan before it:

    [cm, cm, °]     reference            our fit to the map
    freiburg-079    1.54, 1.67, 0.54     0.40, 0.41, 0.15
    intel           1.34, 1.31, 0.30     1.17, 0.98, 0.16
    mac             0.36, 0.57, 0.08     0.30, 0.55, 0.07     (`--only references`)

So the SLAM-corrected logs are granted an uncertainty of 1 cm and 0.3° (`granted`), all
of them the same, and the pseudo ground truth of mac, fitted to this map, none. Both
numbers are shown, with it and without.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table
from thesis.worlds import Options

from fsmsm_jax.alignment import match_batch
from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.evaluation import (
    FARTHEST,
    close_half_scans,
    draw_cases,
    noisy,
    success,
)
from fsmsm_jax.evaluation.cases import bearings
from fsmsm_jax.evaluation.metrics import nees
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import load_map

WORLDS = ("aces", "freiburg_079", "intel", "mit_csail", "mit_killian")
SIGMAS = (0.01, 0.03, 0.05, 0.1)
REAL = ("intel", "intel_first60", "freiburg-079", "mac")
GRANTED = (0.01, np.deg2rad(0.3))
INSIDE = 7.815  # 95 % of χ² with 3 degrees of freedom


class Consistency(NamedTuple):
    """How errors compare with what was claimed."""

    name: str
    scans: int
    wrong: int
    """Matches in a wrong basin, or none at all; not in the numbers below."""
    mean: float
    """Average NEES; 3 is honest."""
    median: float
    """2.37 is honest."""
    inside: float
    """Share within the 95 % ellipsoid."""
    granted: tuple[float, float, float]
    """The same three with the reference's uncertainty added, where it has any."""


def tables(options: Options) -> Iterator[Table]:
    """All rows; without recordings, nothing."""
    if options.data is None:
        return
    text = lambda numbers: " / ".join(f"{value:.2f}" for value in numbers)
    rows = [
        (
            *(row.name, str(row.scans), str(row.wrong)),
            *(text((row.mean, row.median, row.inside)), text(row.granted)),
        )
        for row in consistency(options.data, 10 if options.quick else 150)
    ]
    head = ("set", "n", "wrong", "mean / median / in 95 %", "reference granted its own")
    note = (
        "NEES of right matches; honest: 3 / 2.37 / 0.95. Goal: mean 2.7 to 3.3 "
        "simulated, 1.5 to 6 real. Granted: 1 cm and 0.3° to SLAM-corrected logs."
    )
    yield Table("Are the covariances honest?", head, rows, note)


def consistency(
    data: Path,
    scans: int = 150,
    sigmas: tuple[float, ...] = SIGMAS,
    names: tuple[str, ...] = REAL,
) -> Iterator[Consistency]:
    """Rows of the table, one by one as they are measured.

    Args:
        data: the folder of recordings.
        scans: how many of each set.
        sigmas: noise levels of the simulation [m].
        names: real sets.
    """
    cases = draw_cases(jax.random.key(0), *_thesis_worlds(data, scans))
    for sigma in sigmas:
        yield _row(f"simulation, σ {sigma:g}", *_simulated(cases, sigma))
    for name in names:
        yield _row(name, *_real(data / "real", name, scans))


def _thesis_worlds(data, scans):
    recorded = np.load(data / "thesis" / "environments.npz")
    each = -(-scans // len(WORLDS))
    closed = [close_half_scans(recorded[f"{name}_ranges"]) for name in WORLDS]
    outlines = np.concatenate([worlds.outlines[:each] for worlds in closed])
    poses = np.concatenate([worlds.poses[:each] for worlds in closed])
    return outlines, poses


def _simulated(cases, sigma):
    """Fits, their claims and the truth; nothing is to be granted to the truth."""
    off = jax.random.uniform(jax.random.key(1), cases.true.shape, minval=-1.0)
    starts = cases.true + 0.03 * off
    found, claimed = _fits(*noisy(cases, sigma), starts)
    return found, claimed, cases.true, np.ones(len(found), bool), False


@jax.jit
def _fits(worlds, ranges, starts):
    around = bearings(ranges.shape[1], ranges.dtype)
    limit = jnp.asarray(FARTHEST, ranges.dtype)

    def one(case):
        world, r, start = case
        scan = Scan(r, around, r > 0, r < limit, limit)
        pose, thickness = fit_ranges(world, scan, start, 8)
        return pose, covariance(world, scan, pose, thickness)

    return jax.lax.map(one, (worlds, ranges, starts), batch_size=8)


def _real(folder, name, scans):
    """Matches, their claims and the references."""
    world, log, poses, picked, limit = recording(folder, name, scans)
    batch = stacked(log, picked, limit)
    reference = poses[picked]
    off = np.random.default_rng(0).uniform(-0.2, 0.2, reference.shape)
    found = match_batch(world, batch, reference + off)
    reference = jnp.asarray(reference, found.pose.dtype)
    return (
        found.pose,
        found.covariance,
        reference,
        np.asarray(found.converged),
        name != "mac",
    )


def stacked(log, picked, limit) -> Scan:
    """These scans of a log as one pytree."""
    angles = float(log["angle_min"]), float(log["angle_increment"])
    one = lambda n: Scan.from_ranges(log["ranges"][n], *angles, 0.02, limit)
    return jax.tree.map(lambda *a: jnp.stack(a), *[one(n) for n in picked])


def recording(folder, name, scans):
    """Map, log, references, scans that the map does not know, and their reach [m]."""
    if name == "mac":
        log = np.load(folder / "mac_turtlebot4_take2.npz")
        world = load_map(folder / "mac_1st_floor_9_23.yaml")
        poses, limit = log["pseudo_gt_laser_9_23"], float(log["range_max"])
        unseen = np.flatnonzero(np.isfinite(poses).all(axis=1))
    else:
        log = np.load(folder / f"{name.removesuffix('_first60')}.npz")
        world = load_map(folder / f"{name}.yaml")
        poses, limit = log["poses"], 50.0
        unseen = np.flatnonzero(~log["in_map"])
        if name.endswith("_first60"):
            unseen = np.load(folder / f"{name}_split.npz")["test_index"]
    picked = unseen[
        np.linspace(0, len(unseen) - 1, min(scans, len(unseen))).astype(int)
    ]
    return world, log, poses, picked, limit


def _row(name, found, claimed, true, converged, grant):
    right = np.asarray(success(found, true)) & converged
    metres, radians = GRANTED if grant else (0.0, 0.0)
    reference = jnp.diag(jnp.array([metres, metres, radians]) ** 2)
    raw, granted = (
        _summary(np.asarray(nees(found, true, C), float)[right])
        for C in (claimed, claimed + reference[None])
    )
    return Consistency(name, len(found), int(np.sum(~right)), *raw, granted)


def _summary(squares):
    if not len(squares):
        return float("nan"), float("nan"), float("nan")
    inside = float(np.mean(squares < INSIDE))
    return float(np.mean(squares)), float(np.median(squares)), inside
