"""The way of a robot: on the map, against the truth, and as a cloud of particles.

Colours are those of `localisation`: blue what is believed, red what the sensor says or
what is wrong, violet the rivals, green the truth.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D

from fsmsm_jax.localisation.track import Track
from fsmsm_jax.plotting.colours import DOUBT, INK, POSE, RIVAL, SCAN, TRUTH
from fsmsm_jax.plotting.localisation import plot_pose
from fsmsm_jax.plotting.world import plot_world
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["plot_error_over_time", "plot_particles", "plot_track"]

_AROUND = 5.0  # [m] of the map about a way that are shown at least
_SIGMAS = 3.0  # half the width of a band: 99.7 % of honest errors are in it
_DASH = 0.012  # length of a particle, as a share of the picture
_FAINT = 0.08  # opacity of the lightest particle that is drawn

Poses = Float[np.ndarray, "poses 3"] | Float[Array, "poses 3"]
Vector = Shaped[np.ndarray, "n"] | Shaped[Array, "n"]


def plot_track(
    ax: Axes,
    world: OccupancyGrid | PolygonMap,
    track: Track,
    reference: Poses | None = None,
) -> dict[str, Artist]:
    """The way on the map, coloured by how it is known.

    A blue line where the lidar was tracked, a brown one where that was in doubt, a
    violet one where it was reckoned, a red point for a best guess while it was lost, a
    star where it was found on the whole map. A ring marks the start, an arrowhead the
    end, of what is known.

    Args:
        ax: where to draw.
        world: the map.
        track: what `localisation.track` returned.
        reference: true poses [m, m, rad], drawn green; rows of NaN are gaps.

    Returns:
        What was drawn, by name: of `reference`, `tracking`, `skipped`,
        `doubted`, `lost`, `localised`, `start` and `end` those that there were.
    """
    plot_world(ax, world)
    poses, status = np.asarray(track.pose, float), np.asarray(track.status)
    drawn = {}
    if reference is not None:
        (drawn["reference"],) = ax.plot(
            *np.asarray(reference, float)[:, :2].T, color=TRUTH, lw=2.5, alpha=0.6
        )
        drawn["reference"].set_label("reference")
    legs = np.stack([poses[:-1, :2], poses[1:, :2]], axis=1)
    going_on = (status[:-1] != "lost") & np.isfinite(legs).all(axis=(1, 2))
    for name, color, label in (
        ("tracking", POSE, "tracked"),
        ("skipped", RIVAL, "dead reckoning"),
        ("doubted", DOUBT, "tracked, in doubt"),
    ):
        mine = status == name
        if mine.any():
            lines = LineCollection(
                list(legs[going_on & mine[1:]]), colors=color, lw=1.4
            )
            lines.set_label(f"{label}, {_scans(mine)}")
            drawn[name] = ax.add_collection(lines)
    for name, label, style in (
        ("lost", "lost: best guess", {"marker": ".", "ms": 4, "color": SCAN}),
        (
            "localised",
            "found on the map",
            {"marker": "*", "ms": 13, "color": POSE, "mec": "white", "mew": 0.8},
        ),
    ):
        mine = status == name
        if mine.any():
            (drawn[name],) = ax.plot(*poses[mine, :2].T, ls="", zorder=4, **style)
            drawn[name].set_label(f"{label}, {_scans(mine)}")
    known = poses[(status != "lost") & np.isfinite(poses).all(axis=1)]
    if len(known):
        ring = {"marker": "o", "ms": 9, "mfc": "none", "mec": POSE, "mew": 1.6}
        (drawn["start"],) = ax.plot(*known[0, :2], ls="", zorder=5, **ring)
        drawn["end"], _ = plot_pose(ax, jnp.asarray(known[-1]))
    _frame_way(ax, [poses, *(() if reference is None else (reference,))])
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    return drawn


def _scans(mine: np.ndarray) -> str:
    """How many, in words."""
    return f"{np.sum(mine)} {'scan' if np.sum(mine) == 1 else 'scans'}"


def _frame_way(ax: Axes, ways: Sequence[Poses]) -> None:
    """Limits about all ways, wide enough to see where in the building they lie."""
    points = np.concatenate([np.asarray(way, float)[:, :2] for way in ways])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    margin = max(_AROUND, 0.3 * np.ptp(points, axis=0).max())
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    ax.set_xlim(max(low[0], left), min(high[0], right))
    ax.set_ylim(max(low[1], bottom), min(high[1], top))


def plot_error_over_time(
    ax: Axes, times: Vector, errors: Vector, sigma: Vector, scale: float = 1e3
) -> tuple[Line2D, PolyCollection]:
    """An error against time, in the band that it claims to stay in.

    Args:
        ax: where to draw.
        times: of the scans [s], or their numbers.
        errors: of one coordinate, estimate less truth; NaN is a gap.
        sigma: standard deviations that were claimed, in the unit of the errors; the
            band is ±3 of them, and has a gap where they are not finite.
        scale: from the errors' unit to the axis's; 1000 for mm of m.

    Returns:
        The errors and the band.
    """
    times, errors = np.asarray(times), scale * np.asarray(errors, float)
    half = scale * _SIGMAS * np.asarray(sigma, float)
    there = np.isfinite(half) & np.isfinite(errors)
    band = ax.fill_between(
        times, -half, half, where=there, color=POSE, alpha=0.18, lw=0, label="±3σ"
    )
    (line,) = ax.plot(times, errors, color=SCAN, lw=0.9, label="error")
    ax.axhline(0.0, color=INK, lw=0.5)
    ax.margins(x=0.01)
    return line, band


def plot_particles(
    ax: Axes,
    world: OccupancyGrid | PolygonMap,
    poses: Poses,
    weights: Vector,
    truth: Shaped[np.ndarray, "3"] | Shaped[Array, "3"] | None = None,
) -> tuple[LineCollection, Line2D | None]:
    """A cloud of particles on the map: short strokes from each place along its heading.

    Args:
        ax: where to draw.
        world: the map.
        poses: of the particles [m, m, rad].
        weights: of the particles; the heavier the darker. Those of weight 0 are dead
            and not drawn.
        truth: true pose [m, m, rad], if it is known.

    Returns:
        The strokes, and the arrowhead of the truth.
    """
    plot_world(ax, world)
    weights = np.asarray(weights, float)
    alive = weights > 0
    weights, poses = weights[alive], np.asarray(poses, float)[alive]
    length = _DASH * max(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))
    along = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    strokes = np.stack([poses[:, :2], poses[:, :2] + length * along], axis=1)
    opacity = np.clip(weights / weights.max(initial=1e-30), _FAINT, 1.0)
    lines = LineCollection(list(strokes), colors=RIVAL, lw=1.0, alpha=opacity, zorder=3)
    ax.add_collection(lines)
    arrow = None if truth is None else plot_pose(ax, jnp.asarray(truth), TRUTH, 9)[0]
    return lines, arrow
