"""The map, as the ground of a picture: cells or walls, framed on what is free."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.image import AxesImage
from matplotlib.transforms import Affine2D

from fsmsm_jax.plotting.colours import UNKNOWN, WALL
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["plot_world"]

_MARGIN = 0.5  # [m] around the free space of a map


def plot_world(
    ax: Axes, world: OccupancyGrid | PolygonMap
) -> AxesImage | LineCollection:
    """The map: walls dark, free space white, unknown space grey; frames the axes on it.

    The frame holds what is free and a margin, however much of the picture is unknown.

    Returns:
        The image of a grid, or the lines of a polygon map.
    """
    ax.set_aspect("equal")
    if isinstance(world, PolygonMap):
        _frame(ax, np.concatenate([world.start, world.end]))
        walls = np.stack([world.start, world.end], axis=1)
        lines = LineCollection(list(walls), colors=WALL, linewidths=1.2)
        ax.add_collection(lines)
        return lines

    x, y, yaw = np.asarray(world.origin, float)
    to_map = Affine2D().scale(float(world.resolution)).rotate(yaw).translate(x, y)
    height, width = world.cells.shape
    image = ax.imshow(
        _colours(np.asarray(world.cells)),
        origin="lower",
        extent=(0, width, 0, height),
        transform=to_map + ax.transData,
        interpolation_stage="rgba",
        zorder=0,
    )
    ax.set_facecolor(UNKNOWN)  # beyond the map
    _frame(ax, to_map.transform(_known_cells(world)))
    return image


def _colours(cells: np.ndarray) -> np.ndarray:
    """RGBA of each cell: white to wall colour by occupancy, or unknown.

    Looked up, and with the A that matplotlib would add: maps have millions of cells.
    """
    share = np.arange(101)[:, None] / 100
    known = 1 + share * (np.array(to_rgb(WALL)) - 1)
    colours = np.append(known, [to_rgb(UNKNOWN)], axis=0)
    table = np.full((102, 4), 255, np.uint8)
    table[:, :3] = np.rint(255 * colours)
    return table[np.where(cells < 0, 101, np.minimum(cells, 100))]


def _frame(ax: Axes, points: np.ndarray) -> None:
    """Limits that hold all points [m] and a margin."""
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _known_cells(world: OccupancyGrid) -> np.ndarray:
    """(column, row) of free cells, without rows and columns that hold stray beams."""
    free = np.asarray(world.free)
    least = _MARGIN / float(world.resolution)
    columns, rows = (free.sum(axis=axis) >= least for axis in (0, 1))
    known = np.argwhere(free & columns & rows[:, None])
    return (known if known.size else np.argwhere(np.ones_like(free)))[:, ::-1] + 0.5
