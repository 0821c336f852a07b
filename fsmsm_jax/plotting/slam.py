"""A map of landmarks as it was found, and the figures that compare filters.

Colours of ways are those of `localisation`: blue what was estimated, green what is
true. `plot_particle_errors` and `plot_run_times` have the form of figures 2b, 3b and 4
of the L-SLAM paper, a colour for each method.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.container import BarContainer, ErrorbarContainer

from fsmsm_jax.plotting.colours import INK, POSE, RIVAL, SCAN, TRUTH, UNKNOWN
from fsmsm_jax.slam.landmarks import Landmarks

__all__ = ["SLAM_COLOURS", "plot_particle_errors", "plot_run_times", "plot_slam"]

SLAM_COLOURS = {
    "fastslam1": SCAN,
    "fastslam2": RIVAL,
    "lslam": POSE,
    "lslam2": TRUTH,
    "lslam_joint": INK,
    "lslam2_joint": "#8a4b08",
    "ekf": "#b9bec8",
}
"""Of the methods."""

_Z = 1.96  # standard errors in half a 95 % interval
_SIDE = 0.035  # by which methods stand beside each other, as a share of the axis
_GROUP = 0.8  # width of a group of bars

Poses = Shaped[np.ndarray, "poses 3"] | Float[Array, "poses 3"]
Fixes = Shaped[np.ndarray, "fixes 2"] | Shaped[Array, "fixes 2"]
Places = Shaped[np.ndarray, "surveyed 2"] | Shaped[Array, "surveyed 2"]
Sample = Shaped[np.ndarray, "_"] | Shaped[Array, "_"]


def plot_slam(
    ax: Axes,
    poses: Poses,
    landmarks: Landmarks,
    reference: Fixes | None = None,
    surveyed: Places | None = None,
    sigmas: float = 3.0,
) -> dict[str, Artist]:
    """The way and the map that a filter found, and what is true of both.

    Args:
        ax: where to draw.
        poses: the estimated way [m, m, rad].
        landmarks: of one particle; free slots are not drawn.
        reference: true places, or fixes by GPS [m], green dots; rows of NaN are gaps.
        surveyed: true landmarks [m], green rings.
        sigmas: half axes of the landmarks' ellipses, in standard deviations.

    Returns:
        What was drawn, by name: `way`, `start`, `landmarks` and `covariances`, and of
        `reference` and `surveyed` those that there were.
    """
    poses = np.asarray(poses, float)
    known = np.asarray(landmarks.known)
    x, y = (np.asarray(axis, float)[known] for axis in landmarks.place)
    drawn: dict[str, Artist] = {}
    if reference is not None:
        dots = {"ls": "", "marker": ".", "ms": 5, "mew": 0, "color": TRUTH}
        (drawn["reference"],) = ax.plot(
            *np.asarray(reference, float).T, alpha=0.7, zorder=2, **dots
        )
        drawn["reference"].set_label("true places")
    (drawn["way"],) = ax.plot(*poses[:, :2].T, color=POSE, lw=1.2, label="way")
    ring = {"marker": "o", "ms": 9, "mfc": "none", "mec": POSE, "mew": 1.6}
    (drawn["start"],) = ax.plot(*poses[0, :2], ls="", zorder=5, **ring)
    if surveyed is not None:
        ring = {"marker": "o", "ms": 8, "mfc": "none", "mec": TRUTH, "mew": 1.4}
        (drawn["surveyed"],) = ax.plot(
            *np.asarray(surveyed, float).T, ls="", zorder=3, **ring
        )
        drawn["surveyed"].set_label("surveyed landmarks")
    drawn["covariances"] = ax.add_collection(_ellipses(ax, landmarks, sigmas))
    cross = {"ls": "", "marker": "+", "ms": 6, "mew": 1.2, "color": SCAN}
    (drawn["landmarks"],) = ax.plot(x, y, zorder=4, label="landmarks", **cross)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    return drawn


def _ellipses(ax: Axes, landmarks: Landmarks, sigmas: float) -> EllipseCollection:
    """Of all known landmarks."""
    known = np.asarray(landmarks.known)
    xx, xy, yy = (np.asarray(entry, float)[known] for entry in landmarks.covariance)
    matrices = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    variances, axes = np.linalg.eigh(matrices)
    minor, major = 2 * sigmas * np.sqrt(np.maximum(variances, 0)).T
    angles = np.rad2deg(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    places = np.stack([np.asarray(axis, float)[known] for axis in landmarks.place], 1)
    style = {"facecolors": SCAN, "edgecolors": "none", "alpha": 0.25, "zorder": 3}
    where = {"offsets": places, "offset_transform": ax.transData, "units": "xy"}
    return EllipseCollection(major, minor, angles, **where, **style)


def plot_particle_errors(
    ax: Axes,
    particles: Sequence[int],
    errors: Mapping[str, Sequence[Sample]],
) -> dict[str, ErrorbarContainer]:
    """Errors against the number of particles: a curve for each method.

    Thin whiskers are one standard deviation over the seeds, as in the paper; thick
    ones the 95 % interval of the mean. Methods stand a little beside each other.

    Args:
        ax: where to draw.
        particles: the numbers that were tried.
        errors: of each method, a sample over seeds for each number [m], NaN left out.
            Samples may be fewer than numbers: the first of them were tried.

    Returns:
        The curve of each method.
    """
    drawn, highest = {}, 0.0
    for n, (name, samples) in enumerate(errors.items()):
        side = 1 + _SIDE * (n - (len(errors) - 1) / 2)
        x = np.asarray(particles, float)[: len(samples)] * side
        kept = [np.asarray(sample, float) for sample in samples]
        kept = [sample[np.isfinite(sample)] for sample in kept]
        mean = np.array([np.mean(sample) for sample in kept])
        spread = np.array([np.std(sample) for sample in kept])
        highest = max(highest, *(mean + spread))
        interval = _Z * spread / np.sqrt([max(1, len(sample) - 1) for sample in kept])
        colour = SLAM_COLOURS.get(name, INK)
        ax.errorbar(
            x, mean, spread, fmt="none", color=colour, lw=0.8, capsize=3, alpha=0.6
        )
        ax.errorbar(x, mean, interval, fmt="none", color=colour, lw=3.5, alpha=0.35)
        drawn[name] = ax.errorbar(
            x, mean, fmt="o-", ms=4, lw=1.4, color=colour, label=name
        )
    ax.set_xscale("log")
    ax.set_xticks(list(particles), [str(p) for p in particles])
    ax.minorticks_off()
    ax.set(xlabel="particles", ylabel="position error, RMS [m]")
    ax.set_ylim(0, max(1.05 * highest, ax.get_ylim()[1]))  # axes may be shared
    ax.grid(axis="y", color=UNKNOWN)
    ax.set_axisbelow(True)
    ax.legend(frameon=False)
    return drawn


def plot_run_times(
    ax: Axes,
    particles: Sequence[int],
    times: Mapping[str, Sequence[tuple[float, float, float]]],
    scale: float = 1e6,
) -> dict[str, BarContainer]:
    """Bars of the time of a step: a group for each number of particles.

    Args:
        ax: where to draw.
        particles: of each group.
        times: of each method, median and both ends of its spread for each group [s].
        scale: from seconds to the axis's unit; 1e6 for µs.

    Returns:
        The bars of each method.
    """
    width = _GROUP / len(times)
    middle = np.arange(len(particles))
    drawn = {}
    for n, (name, groups) in enumerate(times.items()):
        median, low, high = scale * np.asarray(groups, float).T
        drawn[name] = ax.bar(
            middle + width * (n - (len(times) - 1) / 2),
            median,
            0.92 * width,
            yerr=[median - low, high - median],
            color=SLAM_COLOURS.get(name, INK),
            error_kw={"lw": 0.8, "ecolor": INK},
            label=name,
        )
    ax.set_xticks(middle, [str(p) for p in particles])
    ax.set(xlabel="particles", ylabel="a step [µs]" if scale == 1e6 else "a step")
    ax.legend(frameon=False)
    return drawn
