"""The basin of convergence: which initial errors a matcher recovers from."""

import numpy as np
from jaxtyping import Array, Shaped
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.contour import QuadContourSet

from fsmsm_jax.plotting.colours import INK

__all__ = ["plot_basin"]


def plot_basin(
    ax: Axes,
    distances: Shaped[np.ndarray, "distances"] | Shaped[Array, "distances"],
    turns: Shaped[np.ndarray, "turns"] | Shaped[Array, "turns"],
    share: Shaped[np.ndarray, "distances turns"] | Shaped[Array, "distances turns"],
    level: float = 0.95,
) -> tuple[QuadMesh, QuadContourSet | None]:
    """Share of cases that came home, over the initial turn and distance.

    Args:
        ax: where to draw.
        distances: initial distances [m], ascending.
        turns: initial errors of the heading [rad], ascending.
        share: in 0..1, as `evaluation.basin` measures it; NaN is left white.
        level: where the line is drawn inside which a matcher may be relied on.

    Returns:
        The coloured cells, and the line; None if no cell is on its other side.
    """
    degrees, share = np.rad2deg(np.asarray(turns)), np.asarray(share)
    distances = np.asarray(distances)
    mesh = ax.pcolormesh(
        degrees,
        distances,
        np.ma.masked_invalid(share),
        shading="nearest",
        cmap="Blues",
        vmin=0.0,
        vmax=1.0,
    )
    line = None
    if min(share.shape) > 1 and np.nanmin(share) < level < np.nanmax(share):
        line = ax.contour(
            degrees, distances, share, [level], colors=INK, linewidths=1.2
        )
    ax.set(xlabel="initial turn [°]", ylabel="initial distance [m]")
    return mesh, line
