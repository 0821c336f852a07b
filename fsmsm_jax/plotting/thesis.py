"""The thesis's figures: errors by noise, what guides the search, how it converges.

The functions take arrays, in metres and radians unless a `scale` says otherwise, and
know nothing of how they came about; `scripts/reproduce_thesis.py` and the notebooks
make them. Errors span decades, so their axes are logarithmic.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Shaped
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.container import ErrorbarContainer
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from fsmsm_jax.plotting.colours import INK, POSE, RIVAL, SCAN, TRUTH

__all__ = [
    "plot_caer",
    "plot_convergence",
    "plot_errors",
    "plot_path",
    "plot_similarity",
    "plot_sweep",
]

COLOURS = (POSE, SCAN, RIVAL, TRUTH, INK)
_QUIET = "#b9bec8"
_BANDS = 30  # of a two-dimensional histogram, per axis
_TRAILS = 60  # single lines drawn lightly behind a median

Vector = Shaped[np.ndarray, "n"] | Shaped[Array, "n"]
Table = Shaped[np.ndarray, "rows columns"] | Shaped[Array, "rows columns"]


def plot_errors(
    ax: Axes,
    errors: Mapping[str, Sequence[Vector]],
    labels: Sequence[str],
    published: Mapping[str, Sequence[Sequence[float]]] | None = None,
    scale: float = 1e3,
) -> dict[str, dict[str, list]]:
    """Box plots side by side: a group for each level of noise, a colour a method.

    A box holds the middle half of the errors and its whiskers nine tenths; its line is
    the median, its dot the mean. Published values, where there are any, stand right
    of their box: a dash for the median, a cross for the mean.

    Args:
        ax: where to draw.
        errors: of each method, a sample for each label.
        labels: under the groups.
        published: of some of the methods, (median, mean) for each label, drawn as they
            are: already in the unit of the axis.
        scale: from the errors' unit to the axis's; 1000 for mm of m.

    Returns:
        What `Axes.bxp` made, by method.
    """
    groups, width = np.arange(len(labels)), 0.8 / max(len(errors), 1)
    boxes = {}
    for number, (name, samples) in enumerate(errors.items()):
        colour = COLOURS[number % len(COLOURS)]
        x = groups + (number - (len(errors) - 1) / 2) * width
        box = ax.bxp(
            [_box(scale * np.asarray(sample, float)) for sample in samples],
            positions=list(x),
            widths=0.6 * width,
            showfliers=False,
            showmeans=True,
            patch_artist=True,
            boxprops={"facecolor": colour, "edgecolor": colour, "alpha": 0.8},
            medianprops={"color": "white", "linewidth": 1.5},
            meanprops=_dot(colour),
            whiskerprops={"color": colour},
            capprops={"color": colour},
        )
        box["boxes"][0].set_label(name)
        boxes[name] = box
        if published and name in published:
            median, mean = np.transpose(published[name])
            beside = x + 0.4 * width
            ax.plot(beside, median, ls="", marker="_", ms=7, mew=2, color=INK, zorder=4)
            ax.plot(beside, mean, ls="", marker="x", ms=5, mew=1.2, color=INK, zorder=4)
    _decades(ax)
    ax.set_xticks(groups, labels)
    ax.grid(axis="y", which="major", color=_QUIET, lw=0.5, alpha=0.6)
    ax.set_axisbelow(True)
    return boxes


def plot_similarity(
    ax: Axes, error: Table, similarity: Table, scale: float = 1e3
) -> tuple[PathCollection, PathCollection]:
    """Percent discrimination against the residual orientation error (Remark XVI).

    Each row is one case: all candidates lightly, and in colour the one with the
    greatest similarity, which percent discrimination would have chosen.

    Args:
        ax: where to draw.
        error: residual orientation errors of the candidates [rad]; their size counts.
        similarity: percent discrimination of the candidates.
        scale: from radians to the unit of the axis.

    Returns:
        All candidates and the chosen ones.
    """
    error = scale * np.abs(np.asarray(error, float))
    # Drawn is what is missing to 1, where all that matters happens.
    missing = np.maximum(1 - np.asarray(similarity, float), 1e-8)  # float32: 0 or 6e-8
    best = np.arange(len(error)), np.argmin(missing, axis=1)
    every = ax.scatter(error, missing, s=3, color=_QUIET, linewidths=0, rasterized=True)
    chosen = ax.scatter(error[best], missing[best], s=9, color=SCAN, linewidths=0)
    every.set_label("all candidates")
    chosen.set_label("most similar of its case")
    ax.set(xscale="log", yscale="log", ylabel="1 − percent discrimination")
    return every, chosen


def plot_caer(
    ax: Axes, error: Vector, caer: Vector, bands: int = _BANDS
) -> tuple[QuadMesh, Line2D]:
    """CAER against pose error, counted, and its median in each band (Remark XVIII).

    Args:
        ax: where to draw.
        error: pose errors [(m² + rad²)^½].
        caer: CAER per ray [m]; must be positive to be drawn.
        bands: of the histogram, along each axis.

    Returns:
        The histogram and the line of medians; bands with fewer than ten pairs have no
        median.
    """
    error, caer = np.asarray(error, float), np.asarray(caer, float)
    drawn = np.isfinite(error) & np.isfinite(caer) & (caer > 0)
    error, caer = error[drawn], caer[drawn]
    across = np.linspace(0, error.max(), bands + 1)
    low, high = np.quantile(caer, [0.001, 0.999])
    up = np.geomspace(low, high, bands + 1)
    *_, mesh = ax.hist2d(error, caer, bins=[across, up], norm=LogNorm(), cmap="Blues")
    band = np.clip(np.digitize(error, across) - 1, 0, bands - 1)
    middle = [
        np.median(caer[band == b]) if np.sum(band == b) >= 10 else np.nan
        for b in range(bands)
    ]
    centres = (across[1:] + across[:-1]) / 2
    (line,) = ax.plot(centres, middle, color=SCAN, lw=2, label="median")
    _decades(ax)
    ax.set_ylabel("CAER per ray [m]")
    return mesh, line


def plot_convergence(
    ax: Axes,
    errors: Table,
    label: str = "",
    colour: str = POSE,
    scale: float = 1.0,
) -> tuple[LineCollection, Line2D]:
    """Error after each step: single cases lightly, their median in full.

    Args:
        ax: where to draw.
        errors: a row for each case, a column for each step, the start first.
        label: of the median, for the legend.
        colour: of all lines.
        scale: from the errors' unit to the axis's.

    Returns:
        The single cases, at most 60 of them, and the median.
    """
    errors = scale * np.asarray(errors, float)
    steps = np.arange(errors.shape[1])
    few = errors[:: -(-len(errors) // _TRAILS)]
    style = {"colors": colour, "linewidths": 0.5, "alpha": 0.25}
    trails = LineCollection([np.column_stack([steps, e]) for e in few], **style)
    ax.add_collection(trails)
    (median,) = ax.plot(
        steps, np.median(errors, axis=0), color=colour, lw=2, label=label
    )
    ax.set_yscale("log")
    return trails, median


def plot_path(
    ax: Axes, positions: Table, colour: str = POSE, label: str = ""
) -> tuple[Line2D, Line2D]:
    """The way a position took, step by step: a ring where it began, a dot a step.

    Args:
        ax: where to draw, a map perhaps.
        positions: x and y after each step, the start first [m].
        colour: of the way.
        label: for the legend.

    Returns:
        The way and the ring.
    """
    x, y = np.asarray(positions, float)[:, :2].T
    (way,) = ax.plot(x, y, ".-", color=colour, lw=1.2, ms=5, label=label, zorder=4)
    ring = {"ms": 9, "mfc": "none", "mew": 1.5, "color": colour, "zorder": 4}
    (start,) = ax.plot(x[:1], y[:1], "o", **ring)
    return way, start


def plot_sweep(
    ax: Axes,
    x: Vector | Sequence[float],
    y: Vector | Sequence[float],
    label: str = "",
    colour: str = POSE,
    interval: tuple[Vector, Vector] | None = None,
    published: Vector | Sequence[float] | None = None,
) -> ErrorbarContainer:
    """A measured curve with its intervals, and the published one dashed beside it.

    Args:
        ax: where to draw.
        x: what was varied.
        y: what was measured.
        label: of the measured curve; the published one adds ", thesis".
        colour: of both.
        interval: lower and upper ends; what is infinite or negative is not drawn.
        published: values at the same x, or at the first of them.

    Returns:
        The measured curve.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    bars = None
    if interval is not None:
        low, high = (np.asarray(end, float) for end in interval)
        low = np.where(np.isfinite(low) & (low > 0), low, y)
        bars = [y - low, np.where(np.isfinite(high), high, y) - y]
    drawn = ax.errorbar(
        x, y, bars, color=colour, marker="o", ms=4, lw=1.5, capsize=2, label=label
    )
    if published is not None:
        theirs = np.asarray(published, float)[: len(x)]
        style = {"color": colour, "marker": "x", "ms": 5, "lw": 1, "ls": "--"}
        ax.plot(x[: len(theirs)], theirs, label=f"{label}, thesis", **style)
    _decades(ax)
    return drawn


def _decades(ax: Axes) -> None:
    """A logarithmic axis upwards, with plain numbers at 1, 2 and 5."""
    ax.set_yscale("log")
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    some = FuncFormatter(
        lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else ""
    )
    ax.yaxis.set_major_formatter(plain)
    low, high = ax.get_ylim()
    ax.yaxis.set_minor_formatter(some if high < 30 * low else NullFormatter())


def _box(sample: np.ndarray) -> dict:
    """What `Axes.bxp` wants to know of a sample."""
    low, q1, median, q3, high = np.percentile(sample, (5, 25, 50, 75, 95))
    return {
        "whislo": low,
        "q1": q1,
        "med": median,
        "q3": q3,
        "whishi": high,
        "mean": np.mean(sample),
        "fliers": [],
    }


def _dot(colour: str) -> dict:
    """A mean: a dot with a white rim."""
    return {"marker": "o", "ms": 4, "mfc": colour, "mec": "white", "mew": 0.8}
