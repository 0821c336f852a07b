"""The way that scans alone tell, drawn on what the keyframes saw of the place.

Colours are those of `localisation`. There is no map: the dots are end points of the
scans that were kept, each set down where its scan was taken. Sharp walls mean that the
way is right; a wall drawn twice, that it strayed in between.
"""

import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from fsmsm_jax.localisation.lidar_odometry import LidarOdometry
from fsmsm_jax.plotting.colours import POSE, RIVAL, SCAN, TRUTH, WALL

__all__ = ["plot_odometry"]

_DOTS = 60_000  # end points that are drawn at most: more only blacken the picture

Poses = Shaped[np.ndarray, "poses 3"] | Float[Array, "poses 3"]


def plot_odometry(
    ax: Axes,
    way: LidarOdometry,
    walls: Shaped[np.ndarray, "points 2"],
    wheels: Poses | None = None,
    reference: Poses | None = None,
) -> dict[str, Artist]:
    """The way of a lidar, what it saw, and what others say of the way.

    Args:
        ax: where to draw.
        way: from `lidar_odometry`.
        walls: end points of the keyframes' scans, in the frame of the way [m].
        wheels: poses by odometry in any frame [m, m, rad], drawn violet from the same
            start; rows of NaN are gaps.
        reference: true ones, drawn green, likewise.

    Returns:
        What was drawn, by name: of `walls`, `wheels`, `reference`, `way`, `unmatched`
        and `start` those that there were.
    """
    walls = np.asarray(walls, float)
    walls = walls[:: -(-len(walls) // _DOTS) or 1]
    drawn: dict[str, Artist] = {}
    dots = {"ls": "", "marker": ".", "ms": 1.5, "mew": 0, "color": WALL}
    (drawn["walls"],) = ax.plot(*walls.T, alpha=0.6, zorder=1, **dots)
    for name, poses, colour in (
        ("reference", reference, TRUTH),
        ("wheels", wheels, RIVAL),
    ):
        line = None if poses is None else _from_the_start(np.asarray(poses), way.pose)
        if line is not None:
            (drawn[name],) = ax.plot(*line.T, color=colour, lw=1.2, label=name)
    (drawn["way"],) = ax.plot(*way.pose[:, :2].T, color=POSE, lw=1.4, label="scans")
    apart = np.isin(way.status, ("skipped", "doubted"))
    if apart.any():
        (drawn["unmatched"],) = ax.plot(
            *way.pose[apart, :2].T, ls="", marker=".", ms=4, color=SCAN, zorder=4
        )
        drawn["unmatched"].set_label(f"not matched, {apart.sum()} of {len(apart)}")
    ring = {"marker": "o", "ms": 9, "mfc": "none", "mec": POSE, "mew": 1.6}
    (drawn["start"],) = ax.plot(*way.pose[0, :2], ls="", zorder=5, **ring)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False)
    return drawn


def _from_the_start(poses, way):
    """Positions in the frame of the way, which both agree on where both begin."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if not known.size:
        return None
    here, there = way[known[0]], poses[known[0]]
    c, s = np.cos(here[2] - there[2]), np.sin(here[2] - there[2])
    turn = np.array([[c, -s], [s, c]])
    return (poses[:, :2] - there[:2]) @ turn.T + here[:2]
