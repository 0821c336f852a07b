"""A campus out of a seed: many buildings, the streets between them, all connected.

Localisation is easy to get right in one building and easy to get slow, or wrong, in a
hundred. A campus asks both: streets cut the site into blocks, as corridors cut a floor,
and each block becomes an office building, one or two wings with a passage between, a
hall full of machines, or a garden. No two are alike, for every one is drawn with
numbers of its own: a right answer exists everywhere. Doors lead outside; trees, benches
and parked cars stand about; a wall surrounds the site.

Source: none; the plan of an office is `buildings.office`'s, see `floor_plan`.
"""

import math

import numpy as np

from fsmsm_jax.world.floor_plan import (
    MARGIN,
    OUTER_WALL,
    Drawing,
    check_size,
    cut,
    furnish,
    open_doors,
    rooms_of,
    split,
)
from fsmsm_jax.world.occupancy import OccupancyGrid

__all__ = ["campus"]

_FREE = 0.81  # share of the site that ends up free, over many seeds
_BLOCK = (45.0, 95.0)  # [m] longest side of a block, from and to
_STREET = (4.0, 9.0)  # [m] width
_NARROW = 14.0  # [m] shorter side of what is only good for a garden
_GATE = 1.6  # [m] wall that an entrance needs, and a quarter of a metre on either side

# What stands outside: (size from, size to) [m], whether it is round, how often.
_OUTSIDE = (
    (((0.3, 0.3), (0.9, 0.9)), True, 0.45),  # trees, bollards
    (((1.2, 0.4), (2.2, 0.6)), False, 0.2),  # benches, bicycle racks
    (((3.8, 1.6), (4.9, 1.9)), False, 0.25),  # cars
    (((2.0, 2.0), (4.5, 3.5)), False, 0.1),  # kiosks, containers
)


def campus(
    seed: int = 0,
    free_area: float = 100_000.0,
    resolution: float = 0.05,
    *,
    unknown: str = "transparent",
) -> OccupancyGrid:
    """A walled site of buildings, halls, gardens and streets, of the size asked for.

    Args:
        seed: which campus; the same arguments give the same one.
        free_area: free space indoors and outdoors [m²], from 3 000; met within a fifth,
            from 25 000 on within a tenth.
        resolution: side of a cell [m], at most 0.2.
        unknown: "transparent" lets rays through unknown space, "opaque" stops them.

    Returns:
        A grid of free (0), occupied (100) and unknown (−1) cells; its lower left corner
        is half a metre outside of the origin. All free space is connected.

    Raises:
        ValueError: less than 3 000 m², a resolution not in (0, 0.2], or more than 10⁸
            cells.

    Example:
        >>> world = campus(seed=1, free_area=3000.0, resolution=0.2)
        >>> 2400 < float(world.free.sum()) * 0.2**2 < 3600
        True

    Note:
        100 000 m² at 0.05 m are some 50 million cells: seconds to draw, and a gigabyte
        as a grid.
    """
    if not 3_000 <= free_area < math.inf:
        raise ValueError(
            f"free_area must be 3000 m² or more, got {free_area}; "
            "for less, ask for buildings.office"
        )
    rng = np.random.default_rng(seed)
    width = math.sqrt(free_area / _FREE) * rng.uniform(0.9, 1.1)
    height = free_area / _FREE / width
    check_size(width, height, resolution)
    site = np.array([[0.0, 0.0], [width, height]])
    drawing = Drawing(width, height, resolution)
    drawing.build(site[None])
    buildings = []
    for block in _blocks(rng, site + [[3.0], [-3.0]]):
        for building in _plots(rng, block):
            _raise(rng, drawing, building)
            buildings.append(building)
    for building in buildings:  # what stands outside, stands outside
        drawing.taken[drawing.window(building)] = True
    _litter(rng, drawing, site)
    return OccupancyGrid.from_cells(
        drawing.connected(), resolution, (-MARGIN, -MARGIN, 0.0), unknown=unknown
    )


def _blocks(rng: np.random.Generator, box: np.ndarray) -> list:
    """What streets leave of a site."""
    size = box[1] - box[0]
    if max(size) < rng.uniform(*_BLOCK):
        return [box]
    axis, street = int(np.argmax(size)), rng.uniform(*_STREET)
    at = box[0, axis] + rng.uniform(0.35, 0.65) * size[axis] - street / 2
    lower, rest = cut(box, axis, at)
    upper = cut(rest, axis, at + street)[1]
    return _blocks(rng, lower) + _blocks(rng, upper)


def _plots(rng: np.random.Generator, block: np.ndarray) -> list:
    """The buildings of a block: none in a garden, or one, or two and a passage."""
    box = block + [[1.0], [-1.0]] * rng.uniform(0.0, 3.0, (2, 2))  # set back
    size = box[1] - box[0]
    if min(size) < _NARROW or rng.random() < 0.05:
        return []
    if max(size) < 2.2 * _NARROW or rng.random() < 0.6:
        return [box]
    axis, passage = int(np.argmax(size)), rng.uniform(2.5, 6.0)
    at = box[0, axis] + rng.uniform(0.4, 0.6) * size[axis]
    lower = cut(box, axis, at - passage / 2)[0]
    upper = cut(box, axis, at + passage / 2)[1]
    upper[1, 1 - axis] -= rng.uniform(0.0, 0.3) * size[1 - axis]  # not in one line
    return [lower, upper]


def _raise(rng: np.random.Generator, drawing: Drawing, building: np.ndarray) -> None:
    """Draw one building, an office or a hall, with doors within and to the outside."""
    drawing.cells[drawing.window(building + [[-OUTER_WALL], [OUTER_WALL]])] = 100
    drawing.cells[drawing.window(building)] = -1  # courtyards
    size = building[1] - building[0]
    if max(size) < 60 and rng.random() < 0.2:
        axis = int(np.argmax(size))
        at = building[0, axis] + rng.uniform(0.6, 0.8) * size[axis]
        hall, wing = cut(building, axis, at)
        corridors, rooms = [], [hall, *split(rng, wing)]
    else:
        hall = None
        corridors, rooms = rooms_of(rng, building)
    boxes = np.array(corridors + rooms)
    drawing.build(boxes)
    open_doors(rng, drawing, boxes, len(corridors))
    _open_entrances(rng, drawing, building, boxes, len(corridors))
    if hall is not None:
        _equip(rng, drawing, hall)
        rooms = rooms[1:]
    furnish(rng, drawing, corridors, rooms)


def _open_entrances(
    rng: np.random.Generator,
    drawing: Drawing,
    building: np.ndarray,
    boxes: np.ndarray,
    corridors: int,
) -> None:
    """Doors to the outside, at the ends of corridors before anywhere else."""
    walls = []
    for n, axis, side in np.ndindex(len(boxes), 2, 2):
        low, high = boxes[n, :, 1 - axis]
        outside = boxes[n, side, axis] == building[side, axis]
        if outside and high - low > _GATE + 0.5:
            walls.append((rng.random() + (n >= corridors), axis, side, low, high))
    count = 2 + round(np.prod(building[1] - building[0]) / 1500)
    for _, axis, side, low, high in sorted(walls)[:count]:
        gap = rng.uniform(1.0, _GATE)
        start = rng.uniform(low + 0.25, high - 0.25 - gap)
        at, ends = float(building[side, axis]), (start, start + gap)
        line, through, _ = drawing.pierce(axis, at, ends, OUTER_WALL)
        drawing.keep_clear(line, through)


def _equip(rng: np.random.Generator, drawing: Drawing, hall: np.ndarray) -> None:
    """Machines, racks and columns, anywhere in a hall."""
    for _ in range(rng.poisson(np.prod(hall[1] - hall[0]) / 14)):
        size = rng.uniform((0.4, 0.4), (4.0, 1.5))
        turn = rng.choice(
            [0.0, math.pi / 2, rng.uniform(0, math.pi)], p=[0.4, 0.4, 0.2]
        )
        drawing.put(
            rng.uniform(hall[0] + 1, hall[1] - 1), size, turn, oval=rng.random() < 0.2
        )


def _litter(rng: np.random.Generator, drawing: Drawing, site: np.ndarray) -> None:
    """Trees, benches and cars wherever there is no building."""
    chances = [chance for *_, chance in _OUTSIDE]
    for _ in range(rng.poisson(np.prod(site[1]) / 30)):
        (low, high), oval, _ = _OUTSIDE[rng.choice(len(_OUTSIDE), p=chances)]
        turn = rng.uniform(0, math.pi)
        place = rng.uniform(site[0] + 3, site[1] - 3)  # not through the outer wall
        drawing.put(place, rng.uniform(low, high), turn, oval=oval)
