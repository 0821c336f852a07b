"""How time grows: median and quartiles over a size, both on logarithmic axes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Shaped
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer

__all__ = ["plot_scaling"]


def plot_scaling(
    ax: Axes,
    sizes: Sequence[float],
    seconds: Sequence[tuple[float, float, float]]
    | Shaped[np.ndarray, "sizes 3"]
    | Shaped[Array, "sizes 3"],
    label: str,
) -> ErrorbarContainer:
    """One line: time [ms] over a size, and a faint one of slope one from its beginning.

    What stays under the faint line grows more slowly than the size.

    Args:
        ax: where to draw.
        sizes: ascending, positive.
        seconds: lower quartile, median and upper quartile for each.
        label: of the line.

    Raises:
        ValueError: there are not as many times as sizes.
    """
    low, median, high = 1e3 * np.asarray(seconds, float).reshape(-1, 3).T
    across = np.asarray(sizes, float)
    if len(across) != len(median):
        raise ValueError(f"{len(across)} sizes, but times of {len(median)}")
    off = np.stack([median - low, high - median])
    drawn = ax.errorbar(across, median, off, marker="o", capsize=3, label=label)
    colour = drawn[0].get_color()
    ax.plot(across, median[0] * across / across[0], ":", color=colour, alpha=0.5)
    ax.set(xscale="log", yscale="log", ylabel="time [ms]")
    ax.grid(alpha=0.3, which="both")
    ax.legend(frameon=False)
    return drawn
