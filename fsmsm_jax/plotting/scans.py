"""What one scan knows of the world: the space that it saw, with walls and veils.

Colours are those of `localisation`. The space is filled, since that something was seen
through is what a scan is surest of. Its border is dark where something stands, and
dotted where only sight ended (`sensing.seen_space`): beside whatever hides the room
behind it, and along the edges of a field of view.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Shaped
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon

from fsmsm_jax.plotting.colours import POSE, WALL
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["SeenSpaceArtists", "plot_seen_space"]

_LEAST = 1e-6  # [m]: segments between rays that saw nothing are points


class SeenSpaceArtists(NamedTuple):
    """What `plot_seen_space` drew."""

    space: Polygon
    """The area that the rays have crossed."""
    walls: LineCollection
    """Its border where something stands."""
    veils: LineCollection
    """Its border where only sight ended."""


def plot_seen_space(
    ax: Axes,
    world: PolygonMap,
    pose: Shaped[np.ndarray, "3"] | Float[Array, "3"] | None = None,
    color: str = POSE,
) -> SeenSpaceArtists:
    """The space that a scan saw; frames the axes on all that was drawn.

    Args:
        ax: where to draw.
        world: one closed outline, as `sensing.seen_space` returns it.
        pose: of the sensor in the frame of the picture [m, m, rad]; if left out, the
            picture is in the frame of the sensor.
        color: of the space and of its veils.

    Returns:
        The artists: space, walls and veils.

    Example:
        >>> from fsmsm_jax import PolygonMap
        >>> from matplotlib.figure import Figure
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> drawn = plot_seen_space(Figure().add_subplot(), room)
        >>> len(drawn.walls.get_segments()), len(drawn.veils.get_segments())
        (4, 0)
    """
    x, y, theta = np.zeros(3) if pose is None else np.asarray(pose, float)
    c, s = np.cos(theta), np.sin(theta)
    place = lambda p: np.asarray(p, float) @ np.array([[c, s], [-s, c]]) + [x, y]
    start, end = place(world.start), place(world.end)
    solid = np.full(len(start), True) if world.solid is None else world.solid
    solid = np.asarray(solid, bool)
    some = np.hypot(*(end - start).T) > _LEAST
    lines = lambda which: np.stack([start, end], axis=1)[which & some]

    space = Polygon(start, closed=True, facecolor=color, alpha=0.12, linewidth=0)
    space.set_zorder(0.5)
    walls = LineCollection(list(lines(solid)), colors=WALL, linewidths=1.4)
    veils = LineCollection(
        list(lines(~solid)), colors=color, linewidths=1.0, linestyles=":"
    )
    ax.add_patch(space)
    ax.add_collection(walls)
    ax.add_collection(veils)
    ax.set_aspect("equal")
    ax.autoscale_view()
    return SeenSpaceArtists(space, walls, veils)
