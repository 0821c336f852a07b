"""Where am I: the map, the scan on it, and how sure the answer is.

The functions stack: `plot_world` first, which also frames the map, then scans, poses
and ellipses in any order. All take map-frame metres, so a turned map (origin with yaw)
and everything on it stay together. `plot_localisation` composes them into the picture
that answers "where am I?" on three scales: the building, the room, and the centimetres
of the covariance ellipse.
"""

import numpy as np
from jaxtyping import Array, ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.transforms import Affine2D

from fsmsm_jax.localisation.settle import Localisation
from fsmsm_jax.plotting.colours import (
    DOUBT,
    INK,
    POSE,
    RIVAL,
    SCAN,
    TRUTH,
)
from fsmsm_jax.plotting.world import plot_world
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "plot_covariance",
    "plot_localisation",
    "plot_pose",
    "plot_scan",
]

_ARROWHEAD = Path(
    [(1, 0), (-0.8, 0.65), (-0.45, 0), (-0.8, -0.65), (1, 0)], closed=True
)
_HALO = [withStroke(linewidth=2.5, foreground="white")]
_NEAR = 0.5  # [m]: a truth nearer than this is shown with the covariance
_RIVALS = 4  # runner-ups worth a number on the map

Pose = Float[Array, "3"] | Float[np.ndarray, "3"]


def plot_scan(
    ax: Axes, scan: Scan, pose: Pose
) -> tuple[LineCollection, PathCollection]:
    """The rays of a scan, lightly, and where they end, seen from a pose.

    Returns:
        The rays and the end points; rays that met nothing are left out.
    """
    # In NumPy: a program for so little would take longer to load than to draw.
    x, y, theta = np.asarray(pose, float)
    echo = np.asarray(scan.echo)
    turned = np.asarray(scan.bearings, float)[echo] + theta
    ahead = np.stack([np.cos(turned), np.sin(turned)], axis=1)
    start = np.broadcast_to([x, y], ahead.shape)
    points = start + np.asarray(scan.ranges, float)[echo, None] * ahead
    rays = _segments(ax, start, points, colors=SCAN, linewidths=0.4, alpha=0.2)
    ends = ax.scatter(*points.T, s=2.5, color=SCAN, linewidths=0, zorder=3)
    return rays, ends


def plot_pose(
    ax: Axes, pose: Pose, color: str = POSE, size: float = 13.0, label: str = ""
) -> tuple[Line2D, Text]:
    """A pose as an arrowhead that points along its heading, `size` points long.

    Returns:
        The arrowhead and its label.
    """
    x, y, theta = np.asarray(pose, float)
    marker = MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(theta))
    (arrow,) = ax.plot(
        x,
        y,
        marker=marker,
        markersize=size,
        color=color,
        mec="white",
        mew=0.8,
        zorder=5,
    )
    text = _note(ax, label, (x, y), (0.7 * size, 0.4 * size), color, 8)
    text.set_fontweight("bold")
    return arrow, text


def plot_covariance(
    ax: Axes,
    pose: Pose,
    covariance: Float[Array, "3 3"] | Float[np.ndarray, "3 3"],
    sigmas: float = 3.0,
) -> Ellipse:
    """The ellipse of a position's uncertainty, `sigmas` standard deviations around it.

    Args:
        ax: where to draw.
        pose: centre of the ellipse [m, m, rad]; the heading is not used.
        covariance: of the pose, map frame [m, m, rad]; its position block is drawn.
        sigmas: half axes in standard deviations: 1 holds 39 %, 2 hold 86 %, 3 hold
            99 % of a Gaussian in the plane.
    """
    variances, axes = np.linalg.eigh(np.asarray(covariance, float)[:2, :2])
    minor, major = 2 * sigmas * np.sqrt(np.maximum(variances, 0))
    angle = np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1]))
    x, y = np.asarray(pose[:2], float)
    ellipse = Ellipse((x, y), major, minor, angle=angle, color=POSE, alpha=0.25)
    ax.add_patch(ellipse)
    return ellipse


def plot_localisation(
    ax: Axes,
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    result: Localisation,
    truth: Pose | None = None,
) -> list[Axes]:
    """Where the scan was taken, how surely, and what else it could have been.

    The map with the scan on it; beside it the same twice magnified, the room with the
    end points on its walls and the centimetres with the ellipses of 1, 2 and 3 σ.
    Numbered arrows are the runner-ups, best first. The two views lie outside the axes:
    save the figure with `bbox_inches="tight"`.

    Args:
        ax: where to draw; it becomes as wide as the map.
        world: the map.
        scan: the scan that was localised.
        result: what `localise` said.
        truth: the pose from which the scan was really taken, if known.

    Returns:
        The three axes: building, room, centimetres.
    """
    plot_world(ax, world)
    room, close = _views(ax)
    plot_world(room, world)
    rivals = result.candidates.poses[np.isfinite(result.candidates.scores)]
    for number, rival in enumerate(rivals[1 : 1 + _RIVALS], start=2):
        plot_pose(ax, rival, RIVAL, 10, str(number))
    spread = np.sqrt(np.maximum(np.diagonal(np.asarray(result.covariance, float)), 0))
    reach = np.clip(np.nan_to_num(4.5 * spread[:2].max()), 0.005, 2.0)
    if truth is not None:
        error = float(np.hypot(*(truth - result.pose)[:2]))
        right = error < _NEAR
        reach = max(reach, 1.5 * error) if right else reach
        plot_pose(close if right else ax, truth, TRUTH, 12, "truth")
    for view in (ax, room):
        plot_scan(view, scan, result.pose)
        plot_pose(view, result.pose, label="" if result.confident else "1")
    for sigmas in (1, 2, 3):
        plot_covariance(close, result.pose, result.covariance, sigmas)
    plot_pose(close, result.pose, size=18)
    close.text(0.03, 0.94, "1, 2, 3 σ", size=8, color=POSE, transform=close.transAxes)
    echoes = np.asarray(scan.ranges)[np.asarray(scan.echo)]
    building = min(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))
    room_reach = np.clip(np.quantile([*echoes, 3.0], 0.75), 2.5, 0.4 * building)
    x, y = np.asarray(result.pose[:2], float)
    frame = Rectangle((x - room_reach, y - room_reach), 2 * room_reach, 2 * room_reach)
    ax.add_patch(frame).set(fill=False, edgecolor=POSE, linewidth=1.0, zorder=4)
    room.spines[:].set(color=POSE, linewidth=1.0, alpha=1.0)
    for view, half in ((room, room_reach), (close, reach)):
        view.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
        _scale_bar(view)
    _scale_bar(ax)
    _title(ax, result, spread)
    return [ax, room, close]


def _segments(ax: Axes, start: ArrayLike, end: ArrayLike, **style) -> LineCollection:
    """Straight lines from each start to its end."""
    lines = LineCollection(list(np.stack([start, end], axis=1)), **style)
    ax.add_collection(lines)
    return lines


def _views(ax: Axes) -> tuple[Axes, Axes]:
    """Two square axes beside the map; below it where it is much wider than high."""
    width, height = np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())
    if width > 2 * height:
        side = 0.49 * width / height
        boxes = [(x, -0.05 - side, 0.49, side) for x in (0.0, 0.51)]
    else:
        side = 0.485 * height / width
        gap = 0.03 * height / width
        boxes = [(1 + gap, y, side, 0.485) for y in (0.515, 0.0)]
    views = [ax.inset_axes(box) for box in boxes]
    for view in (ax, *views):
        view.set_aspect("equal")
        view.set(xticks=[], yticks=[])
        view.spines[:].set(color=INK, linewidth=0.6, alpha=0.6)
    return views[0], views[1]


def _scale_bar(ax: Axes) -> None:
    """A bar of a round length, about a fifth of the width, in the lower left corner."""
    width = np.ptp(ax.get_xlim())
    decade = 10.0 ** np.floor(np.log10(width / 5))
    length = max(step * decade for step in (1, 2, 5) if step * decade <= width / 4)
    sizes = (f"{length:g} m", f"{100 * length:g} cm", f"{1000 * length:g} mm")
    x, y = ax.transLimits.inverted().transform((0.03, 0.03))
    _note(ax, sizes[sum((length < 1, length < 0.01))], (x, y), (0, 3), INK, 7)
    ax.plot([x, x + length], [y, y], color=INK, lw=1.5, path_effects=_HALO, zorder=6)


def _note(ax: Axes, text: str, at, offset, color: str, size: float) -> Text:
    """Small print on a white halo, `offset` points from a map-frame point [m]."""
    return ax.annotate(
        text,
        at,
        xytext=offset,
        textcoords="offset points",
        color=color,
        fontsize=size,
        path_effects=_HALO,
        annotation_clip=True,
        zorder=6,
    )


def _title(ax: Axes, result: Localisation, spread: np.ndarray) -> None:
    """The verdict, and under it the numbers on which it rests."""
    x, y, theta = np.asarray(result.pose, float)
    place = f"x {x:.2f} m, y {y:.2f} m, θ {np.rad2deg(theta):.1f}°".replace("-", "−")
    head, color = ("Confident", POSE) if result.confident else ("Not confident", DOUBT)
    style = {"fontsize": 13, "fontweight": "bold", "color": color}
    ax.set_title(f"{head}: {place}", style, loc="left", pad=22)
    facts = (
        f"±{1e3 * spread[0]:.0f} mm, ±{1e3 * spread[1]:.0f} mm, "
        f"±{np.rad2deg(spread[2]):.2f}° (1σ)   ·   CAER "
        f"{100 * float(result.caer_per_ray):.1f} cm per ray   ·   the map explains "
        f"{float(result.explained):.0%} of the rays"
    )
    ax.annotate(
        facts,
        (0, 1),
        xytext=(0, 7),
        xycoords="axes fraction",
        textcoords="offset points",
        fontsize=9,
        color=INK,
    )
