"""What the commands share: timing, the words for a scan and a pose, saved pictures."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import jax
import numpy as np

from fsmsm_jax.io.logs import ScanLog
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_T = TypeVar("_T")


def timed(function: Callable[[], _T]) -> tuple[_T, float]:
    """What the function returns, once it is computed, and the seconds that took."""
    start = time.perf_counter()
    value = jax.block_until_ready(function())
    return value, time.perf_counter() - start


def area(world: OccupancyGrid) -> float:
    """Free space [m²]."""
    return float(world.free.sum() * world.resolution**2)


def summary(scan: Scan) -> str:
    """How many rays over what field of view, and how many met something."""
    bearings = np.unwrap(np.asarray(scan.bearings))
    view = np.rad2deg(np.ptp(bearings))
    return f"{scan.ranges.size} rays over {view:.0f}°, {int(scan.echo.sum())} echoes"


def pose_in_words(pose, covariance) -> str:
    """A pose with the standard deviations of its numbers."""
    x, y, theta = np.asarray(pose, float)
    sx, sy, st = np.sqrt(np.diagonal(np.asarray(covariance, float)))
    return (
        f"x {x:.3f} m ± {sx:.3f}, y {y:.3f} m ± {sy:.3f}, "
        f"heading {np.rad2deg(theta):.2f}° ± {np.rad2deg(st):.2f}  (1σ)"
    )


def tell_remarks(log: ScanLog) -> None:
    """What is odd about a log, on stderr."""
    for remark in log.remarks:
        print(f"remark    {remark}", file=sys.stderr)


def save_picture(path: Path, draw: Callable[["Axes"], object]) -> None:
    """Draw on fresh axes and save them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7))
    draw(figure.add_subplot())
    figure.savefig(path, dpi=160, bbox_inches="tight", facecolor="white")
