"""People in the way: does a kernel that knows the sensor help on cmu_wean?

Two logs of a corridor with people walking by, on a map that was made without them.
Each scan is refined from a guess up to 0.2 m (in x, in y) and 0.2 rad off its reference
pose, once with kernels that treat short and long ranges alike and once with those that
expect things in front of walls.

The map draws walls some 0.2 m thick and the references are themselves a scan-to-map
fit, so centimetres mean little here; and along a corridor a scan of 180° says little.
Hence errors are told apart: all of them, and those across the corridor, the direction
in which the scan is most informative.
"""

import math
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table
from thesis.worlds import Options

from fsmsm_jax.alignment import (
    Absolute,
    BeamModel,
    GemanMcClure,
    Kernel,
    PseudoHuber,
    refine,
)
from fsmsm_jax.alignment.residuals import range_residuals
from fsmsm_jax.evaluation import pose_errors
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, load_map

LOGS = ("cmu_wean_log1", "cmu_wean_log2")
OFF = np.array([0.2, 0.2, 0.2])  # [m, m, rad] largest error of the guess
RIGHT = 0.10, np.radians(2)  # [m], [rad]
KERNELS: dict[str, Kernel] = {
    "absolute (CAER)": Absolute(),
    "pseudo-Huber": PseudoHuber(0.1),
    "Geman-McClure": GemanMcClure(0.2),
    "beam model, short = long": BeamModel(0.15, short=0.03, long=0.03),
    "beam model, short expected": BeamModel(0.15, short=0.1, long=0.01),
    "beam model, long expected": BeamModel(0.15, short=0.01, long=0.1),
}
"""The last is the wrong way round, for comparison."""


class WeanRow(NamedTuple):
    """What one kernel makes of the scans."""

    kernel: str
    scans: int
    right: float
    """Share within 0.1 m and 2° of the reference."""
    position: float
    """Median distance [m]."""
    across: float
    """Median error in the best measured direction [m]."""
    across_right: float
    """Share within 0.1 m in that direction, and 2°."""
    turn: float
    """Median error of the heading [rad]."""
    seconds: float
    """A scan, in one batch."""


def tables(options: Options) -> Iterator[Table]:
    """One row a kernel; without the recording, nothing."""
    if options.data is None:
        return
    rows = [
        (
            *(row.kernel, f"{100 * row.right:.0f} %", f"{1e3 * row.position:.0f}"),
            *(f"{100 * row.across_right:.0f} %", f"{1e3 * row.across:.0f}"),
            *(f"{math.degrees(row.turn):.2f}", f"{1e3 * row.seconds:.1f}"),
        )
        for row in wean(options.data, 10 if options.quick else 200)
    ]
    head = (
        *("kernel", "right", "median [mm]", "right across", "median [mm]"),
        *("heading [°]", "ms a scan"),
    )
    note = "Right: within 0.1 m and 2° of the reference; across: in the best direction."
    yield Table("People in the way: cmu_wean", head, rows, note)


def wean(data: Path, count: int = 200, method: str = "gauss_newton") -> list[WeanRow]:
    """One row a kernel, the guesses themselves first.

    Args:
        data: folder of the recordings, which holds `real/cmu_wean.yaml`.
        count: scans, evenly from both logs.
        method: of `refine`.

    Raises:
        FileNotFoundError: the recordings are not there.
    """
    world, scans, true = wean_scans(data, count)
    away = OFF * np.random.default_rng(0).uniform(-1, 1, true.shape)
    start = true + jnp.asarray(away, true.dtype)
    axis = np.asarray(_best_direction(world, scans, true))
    rows = [_row("guess", start, true, axis, 0.0)]
    for name, kernel in KERNELS.items():
        ask = partial(_refined, world, scans, start, kernel, method)
        found = jax.block_until_ready(ask())
        begun = time.perf_counter()
        jax.block_until_ready(ask())
        rows.append(_row(name, found, true, axis, time.perf_counter() - begun))
    return rows


def wean_scans(data: Path, count: int) -> tuple[OccupancyGrid, Scan, jax.Array]:
    """The map, scans stacked, and their reference poses."""
    folder = data / "real"
    files = [folder / f"{name}.npz" for name in LOGS]
    for file in (folder / "cmu_wean.yaml", *files):
        if not file.is_file():
            raise FileNotFoundError(f"no recording {file}; point FSMSM_DATA at them")
    scans, poses = [], []
    for file in files:
        with np.load(file) as log:
            ranges, true = log["ranges"], log["pseudo_gt_laser"]
            angles = float(log["angle_min"]), float(log["angle_increment"])
            limit = float(log["no_return_above"])
        share = -(-count // len(files))
        chosen = np.linspace(0, len(ranges) - 1, share).astype(int)
        scans += [Scan.from_ranges(ranges[i], *angles, 0.0, limit) for i in chosen]
        poses.append(true[chosen])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scans)
    poses = jnp.asarray(np.concatenate(poses), float)
    return load_map(folder / "cmu_wean.yaml"), stacked, poses


@partial(jax.jit, static_argnames="method")
def _refined(world, scans, poses, kernel, method):
    ask = lambda scan, pose: refine(world, scan, pose, method, kernel).pose
    return jax.vmap(ask)(scans, poses)


@jax.jit
def _best_direction(world, scans, poses):
    """Unit vector [x, y] in which the ranges that agree fix each position best."""

    def one(scan, pose):
        e, J, known = range_residuals(world, scan, pose)
        J = jnp.where((known & (jnp.abs(e) < 0.6))[:, None], J[:, :2] / J[:, 3:], 0.0)
        return jnp.linalg.eigh(J.T @ J)[1][:, 1]

    return jax.vmap(one)(scans, poses)


def _row(name, found, true, axis, seconds) -> WeanRow:
    position, turn = (np.asarray(e) for e in pose_errors(found, true))
    across = np.abs(np.sum(np.asarray(found - true)[:, :2] * axis, axis=1))
    return WeanRow(
        kernel=name,
        scans=len(turn),
        right=float(np.mean((position < RIGHT[0]) & (turn < RIGHT[1]))),
        position=float(np.median(position)),
        across=float(np.median(across)),
        across_right=float(np.mean((across < RIGHT[0]) & (turn < RIGHT[1]))),
        turn=float(np.median(turn)),
        seconds=seconds / len(turn),
    )
