"""Buildings out of a seed: floor plans of any size, with nothing to download.

A plan is drawn as an architect blocks one out. Corridors cut the building, each ending
on an earlier one, until blocks a few rooms deep are left; the blocks are cut into rooms
of very different sizes, and some are left out as courtyards and recesses. A wall
surrounds every room. The doors are a random spanning tree of the rooms that touch, one
that prefers corridors, plus a few more, so that every room can be reached. Pillars and
furniture come last and keep clear of the doors. What a robot could not drive to is
unknown, as in a map that a robot made.

`office` is one floor; `campus` is a site of many buildings and the streets between.
"""

import math

import numpy as np

from fsmsm_jax.world.campus import campus
from fsmsm_jax.world.floor_plan import (
    MARGIN,
    Drawing,
    check_size,
    furnish,
    open_doors,
    rooms_of,
)
from fsmsm_jax.world.occupancy import OccupancyGrid

__all__ = ["campus", "office"]


def office(
    seed: int = 0,
    width: float = 40.0,
    height: float = 25.0,
    resolution: float = 0.05,
    *,
    furnished: bool = True,
    unknown: str = "transparent",
) -> OccupancyGrid:
    """A plausible office floor: corridors, rooms, doors, pillars and furniture.

    The building fills [0, width] × [0, height] of the map frame, half a metre of
    unknown space around it. All free space is connected, and the outer wall is closed.

    Args:
        seed: which building; the same arguments give the same building.
        width: extent in x [m], from 6 to 300 or so.
        height: extent in y [m], from 6 to 300 or so.
        resolution: side of a cell [m], at most 0.2.
        furnished: whether pillars and furniture stand in the rooms.
        unknown: "transparent" lets rays through unknown space, "opaque" stops them.

    Returns:
        A grid of free (0), occupied (100) and unknown (−1) cells.

    Raises:
        ValueError: a side is shorter than 6 m, the resolution is not in (0, 0.2], or
            the map would have more than 10⁸ cells.

    Example:
        >>> world = office(seed=3, width=20.0, height=12.0)
        >>> world.cells.shape
        (260, 420)
    """
    if not (6 <= width < math.inf and 6 <= height < math.inf):
        raise ValueError(f"both sides must be 6 m or more, got {width} m × {height} m")
    check_size(width, height, resolution)
    rng = np.random.default_rng(seed)
    corridors, rooms = rooms_of(rng, np.array([[0.0, 0.0], [width, height]]))
    drawing = Drawing(width, height, resolution)
    drawing.build(np.array(corridors + rooms))
    open_doors(rng, drawing, np.array(corridors + rooms), len(corridors))
    if furnished:
        furnish(rng, drawing, corridors, rooms)
    return OccupancyGrid.from_cells(
        drawing.connected(), resolution, (-MARGIN, -MARGIN, 0.0), unknown=unknown
    )
