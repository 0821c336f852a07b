"""What commands share: kept programs, timing, words for scan and pose, pictures."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import jax
import numpy as np

from fsmsm_jax.io.logs import ScanLog
from fsmsm_jax.io.programs import recalled
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_T = TypeVar("_T")


def cache_folder() -> Path | None:
    """Where programs are kept, if they are to be and the folder can be written."""
    if "FSMSM_NO_CACHE" in os.environ:
        return None
    root = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    kept = os.environ.get("JAX_COMPILATION_CACHE_DIR") or Path(root) / "fsmsm_jax"
    try:
        Path(kept).mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return Path(kept)


def keep_compiled_programs() -> None:
    """Point JAX's compilation cache at the user's folder, if that can be written."""
    folder = cache_folder()
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # All of them: even the shortest takes longer to compile than to load.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def without_tracing(
    function: Callable[..., _T], arguments: tuple, like: _T
) -> Callable[[], _T]:
    """A jitted function of these arguments, its trace kept where programs are.

    Args:
        function: of the package.
        arguments: of the function.
        like: of the structure of its result, whatever its leaves.
    """
    folder = cache_folder()
    if folder is None:
        return lambda: function(*arguments)
    return recalled(folder / "traces", function, arguments, like)


def timed(function: Callable[[], _T]) -> tuple[_T, float]:
    """What the function returns, once it is computed, and the seconds that took."""
    start = time.perf_counter()
    value = jax.block_until_ready(function())
    return value, time.perf_counter() - start


def area(world: OccupancyGrid) -> float:
    """Free space [m²]."""
    return np.asarray(world.free).sum() * float(world.resolution) ** 2


def summary(scan: Scan) -> str:
    """How many rays over what field of view, and how many met something."""
    bearings = np.unwrap(np.asarray(scan.bearings))
    view = np.rad2deg(np.ptp(bearings))
    echoes = np.asarray(scan.echo).sum()
    return f"{scan.ranges.size} rays over {view:.0f}°, {echoes} echoes"


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
