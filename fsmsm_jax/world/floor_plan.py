"""How a floor is drawn: boxes, walls, doors, furniture.

A plan is a list of boxes side by side: corridors first, then rooms. `rooms_of` invents
one, `Drawing` is the sheet of cells on which it is built, `open_doors` connects it and
`furnish` fills it. `buildings.office` is one such plan, `campus` a site full of them.

Boxes are arrays [[left, bottom], [right, top]] in metres, and `axis` 0 is x, 1 is y:
what is done to one axis is done to the other by the same line.
"""

import math

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix, csgraph

__all__ = [
    "MARGIN",
    "Drawing",
    "check_size",
    "cut",
    "furnish",
    "open_doors",
    "rooms_of",
    "split",
]

MARGIN = 0.5  # [m] of unknown space around the building
_INNER_WALL = 0.07  # [m] on either side of the line between two rooms
OUTER_WALL = 0.16  # [m] beyond that line where no room follows
_SMALLEST_ROOM = 2.3  # [m] its shorter side
SHORTEST_WALL = 1.75  # [m] that takes a door; every corridor is wider
DOOR_FRAME = 0.3  # [m] from a door to the next corner
_LARGEST_MAP = 100_000_000  # [cells]

# Furniture: how far it goes along the wall, and into the room, from and to [m].
_DESK = ((1.2, 0.6), (1.8, 0.8))
_STORAGE = (((0.8, 0.3), (2.4, 0.45)), ((0.3, 0.3), (1.0, 0.65)))
_HALLWAY = (((0.9, 0.3), (2.7, 0.4)), ((0.3, 0.15), (0.6, 0.3)))


def check_size(width: float, height: float, resolution: float) -> None:
    """Refuse a sheet that nothing can be drawn on.

    Raises:
        ValueError: the resolution is not in (0, 0.2], or the map would have more than
            10⁸ cells.
    """
    if not 0 < resolution <= 0.2:  # a coarser grid loses doors and walls
        raise ValueError(f"resolution must be in (0, 0.2] m, got {resolution}")
    if width * height / resolution**2 > _LARGEST_MAP:
        raise ValueError(
            f"{width:g} m × {height:g} m at {resolution} m is more than "
            f"{_LARGEST_MAP:.0e} cells; ask for a smaller one or a coarser resolution"
        )


def rooms_of(rng: np.random.Generator, building: np.ndarray) -> tuple[list, list]:
    """Corridors and rooms: boxes side by side, without gaps but for the courtyards.

    A corridor along one axis must end on an earlier one, so only blocks that a corridor
    flanks at either end of that axis may be cut.
    """
    corridors, blocks = [], []
    waiting = [(building, np.array([False, False]))]
    while waiting:
        box, flanked = waiting.pop()
        size = box[1] - box[0]
        limit = np.where(size == size.min(), rng.uniform(10, 14), rng.uniform(18, 30))
        need = (size / limit)[::-1] * (flanked | ~flanked.any())
        axis = int(np.argmax(need))
        across = 1 - axis
        hall = rng.uniform(1.8, 2.5) + (rng.random() < 0.2) * rng.uniform(0.4, 1.2)
        if need[axis] < 1:
            blocks.append(box)
            continue
        at = box[0, across] + rng.uniform(0.38, 0.62) * size[across] - hall / 2
        lower, rest = cut(box, across, at)
        corridor, upper = cut(rest, across, at + hall)
        corridors.append(corridor)
        flanked = flanked | (np.arange(2) == across)
        waiting += [(lower, flanked), (upper, flanked)]
    rooms = []
    for box in blocks:
        small = np.prod(box[1] - box[0]) < 250
        if len(blocks) < 3 or not small or rng.random() > 0.08:  # else a courtyard
            rooms += split(rng, box)
    # Where there are corridors, a room may be missing: a shaft or a recess.
    return corridors, [box for box in rooms if not corridors or rng.random() > 0.03]


def split(rng: np.random.Generator, box: np.ndarray) -> list:
    """Halve a box, unevenly, until each part is as small as chance wants it."""
    size = box[1] - box[0]
    longer, shorter = max(size), min(size)
    wanted = rng.lognormal(math.log(20), 0.8)
    slender = longer > 2.2 * shorter
    if longer < 2 * _SMALLEST_ROOM or (longer * shorter < wanted and not slender):
        return [box]
    at = rng.uniform(0.3, 0.7) * longer
    at = np.clip(at, _SMALLEST_ROOM, longer - _SMALLEST_ROOM)
    axis = int(np.argmax(size))
    lower, upper = cut(box, axis, box[0, axis] + at)
    return split(rng, lower) + split(rng, upper)


def cut(box: np.ndarray, axis: int, at: float) -> tuple[np.ndarray, np.ndarray]:
    """The parts of a box below and above a line across an axis."""
    lower, upper = box.copy(), box.copy()
    lower[1, axis] = upper[0, axis] = at
    return lower, upper


class Drawing:
    """The cells being drawn, and where nothing may be put any more."""

    def __init__(self, width: float, height: float, resolution: float):
        shape = [round((side + 2 * MARGIN) / resolution) for side in (height, width)]
        self.resolution = resolution
        self.cells = np.full(shape, -1, np.int8)
        self.taken = np.zeros(shape, bool)

    def window(self, box: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of the cells in a box."""
        cells = np.rint((box + MARGIN) / self.resolution)
        low, high = np.clip(cells, 0, self.cells.shape[::-1]).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def build(self, boxes: np.ndarray) -> None:
        """A wall around every box; where boxes meet, they share it."""
        inner = max(_INNER_WALL, 0.55 * self.resolution)  # a cell remains of the two
        for box in boxes:
            self.cells[self.window(box + [[-OUTER_WALL], [OUTER_WALL]])] = 100
        for box in boxes:
            self.cells[self.window(box + [[inner], [-inner]])] = 0

    def pierce(self, axis: int, at: float, ends, depth: float):
        """Open a wall across an axis between two ends, so deep to either side of it.

        Returns the line's two ends, and unit vectors through the wall and along it.
        """
        through, along = np.eye(2)[[axis, 1 - axis]]
        line = at * through + np.outer(ends, along)
        deep = np.outer((-1, 1), through) * (depth + self.resolution)
        self.cells[self.window(line + deep)] = 0
        return line, through, along

    def keep_clear(self, line: np.ndarray, through: np.ndarray) -> None:
        """Nothing may be put before or behind a door."""
        self.taken[self.window(line + 1.1 * np.outer((-1, 1), through))] = True

    def connected(self) -> np.ndarray:
        """The cells; of the free ones only the largest connected part remains known."""
        part = np.empty(self.cells.shape, np.int32)
        ndimage.label(self.cells == 0, output=part)
        largest = 1 + np.argmax(np.bincount(part.ravel())[1:])
        self.cells[(part > 0) & (part != largest)] = -1
        return self.cells

    def put(self, centre, size, angle: float = 0.0, *, oval: bool = False) -> None:
        """Put a turned box or oval of that size there, unless something is there."""
        half = np.maximum(size, 1.5 * self.resolution) / 2
        reach = np.full(2, math.hypot(*half) + self.resolution)
        rows, columns = self.window(np.array([centre - reach, centre + reach]))
        y, x = np.ogrid[rows, columns]
        x = (x + 0.5) * self.resolution - MARGIN - centre[0]
        y = (y + 0.5) * self.resolution - MARGIN - centre[1]
        u = np.abs(x * math.cos(angle) + y * math.sin(angle)) / half[0]
        v = np.abs(y * math.cos(angle) - x * math.sin(angle)) / half[1]
        inside = (u**2 + v**2 if oval else np.maximum(u, v)) <= 1
        if not (inside & self.taken[rows, columns]).any():
            self.cells[rows, columns][inside] = 100
            self.taken[rows, columns] |= inside


def open_doors(
    rng: np.random.Generator, drawing: Drawing, boxes: np.ndarray, corridors: int
) -> None:
    """Open a spanning tree of the boxes sharing a wall, corridors first, and more."""
    walls = _shared_walls(boxes, 0) + _shared_walls(boxes, 1)
    i, j = np.array([wall[:2] for wall in walls], int).reshape(-1, 2).T
    cost = 1 + rng.random(len(walls)) + 10 * (i >= corridors) + 10 * (j >= corridors)
    graph = coo_matrix((cost, (i, j)), shape=(len(boxes), len(boxes)))
    tree = set(zip(*csgraph.minimum_spanning_tree(graph).nonzero(), strict=True))
    for i, j, axis, at, low, high in walls:
        junction = max(i, j) < corridors
        if not (junction or (i, j) in tree or rng.random() < 0.07):
            continue
        wide = high - low > 4 and rng.random() < 0.2
        gap = rng.uniform(1.5, 1.9) if wide else rng.uniform(0.85, 1.1)
        start = low + DOOR_FRAME + rng.random() * (high - low - 2 * DOOR_FRAME - gap)
        ends = (
            (low + _INNER_WALL, high - _INNER_WALL)
            if junction
            else (start, start + gap)
        )
        line, through, along = drawing.pierce(axis, at, ends, depth=0.12)
        if not (junction or wide) and rng.random() < 0.6:  # its leaf stands open
            swing, inward = rng.uniform(0, 0.25), -1 if j < corridors else 1
            leaf = gap * (math.cos(swing) * inward * through - math.sin(swing) * along)
            hinge = line[0] + _INNER_WALL * inward * through
            drawing.put(hinge + leaf / 2, (gap, 0.05), math.atan2(leaf[1], leaf[0]))
        drawing.keep_clear(line, through)


def _shared_walls(boxes: np.ndarray, axis: int) -> list:
    """Walls across an axis that take a door: (box, next box, axis, at, low, high)."""
    i, j = np.nonzero(boxes[:, None, 1, axis] == boxes[None, :, 0, axis])
    low = np.maximum(boxes[i, 0, 1 - axis], boxes[j, 0, 1 - axis])
    high = np.minimum(boxes[i, 1, 1 - axis], boxes[j, 1, 1 - axis])
    walls = zip(i, j, boxes[i, 1, axis], low, high, strict=True)
    return [(i, j, axis, *w) for i, j, *w in walls if w[2] - w[1] > SHORTEST_WALL]


def furnish(
    rng: np.random.Generator, drawing: Drawing, corridors: list, rooms: list
) -> None:
    """Cupboards along the corridors, and in each room what its size suggests."""
    for box in corridors:
        for _ in range(rng.poisson(max(box[1] - box[0]) / 5)):
            piece = rng.uniform(*_HALLWAY[rng.integers(len(_HALLWAY))])
            _against_wall(rng, drawing, box, piece)
    for box in rooms:
        _furnish_room(rng, drawing, box)


def _furnish_room(rng: np.random.Generator, drawing: Drawing, box: np.ndarray) -> None:
    """Pillars, and the furniture of whatever the room's size makes it."""
    size, middle = box[1] - box[0], box.mean(axis=0)
    area, long = np.prod(size), np.argmax(size)
    turned = (lambda pair: np.array(pair)[::-1]) if long == 1 else np.array
    if min(size) > 5.5:
        counts = np.rint(size / rng.uniform(3.2, 5.0)).astype(int)
        _grid(
            drawing, box, counts, np.full(2, rng.uniform(0.3, 0.6)), rng.random() < 0.5
        )
    kind = rng.choice(["study", "meeting", "store", "tables"], p=[0.5, 0.2, 0.12, 0.18])
    if kind == "meeting" and area > 14:
        table = np.array([max(size) * rng.uniform(0.35, 0.55), rng.uniform(0.9, 1.4)])
        chairs = middle + np.outer((-0.5, 0.5), turned((table[0], 2 * table[1] + 1.2)))
        _grid(drawing, chairs, turned((int(table[0] / 0.75), 2)), (0.42, 0.42), True)
        drawing.put(middle, turned(table), oval=rng.random() < 0.4)
    elif kind == "store" and min(size) > 3:
        shelf = (rng.uniform(0.4, 0.6), min(size) - rng.uniform(1.8, 2.2))
        rows = int((max(size) - 1.2) / rng.uniform(1.4, 1.9))
        _grid(drawing, box, turned((rows, 1)), turned(shelf), False)
    elif kind == "tables" and area > 14:
        for _ in range(rng.poisson(area / 9)):
            table = rng.uniform(0.6, 1.3, 2)
            place = rng.uniform(box[0] + 1, box[1] - 1)
            drawing.put(place, table, rng.uniform(0, 3.14), oval=rng.random() < 0.5)
    else:
        for _ in range(1 + rng.poisson(area / 9)):
            _against_wall(rng, drawing, box, rng.uniform(*_DESK), chair=True)
    for _ in range(rng.poisson(1 + area / 12)):
        piece = rng.uniform(*_STORAGE[rng.integers(len(_STORAGE))])
        _against_wall(rng, drawing, box, piece)
    if rng.random() < 0.4:  # something left standing about
        place = rng.uniform(box[0] + 0.6, box[1] - 0.6)
        drawing.put(place, rng.uniform(0.3, 0.8, 2), rng.uniform(0, 3.14))


def _grid(drawing: Drawing, box: np.ndarray, counts, size, oval: bool) -> None:
    """Equal pieces, evenly spread over a box."""
    for place in np.ndindex(*counts):
        at = box[0] + (box[1] - box[0]) * (np.array(place) + 0.5) / counts
        drawing.put(at, size, oval=oval)


def _against_wall(
    rng: np.random.Generator, drawing: Drawing, box, piece, *, chair: bool = False
) -> None:
    """A piece, (along, into the room), at one of the walls, and perhaps a chair."""
    side = rng.integers(4)
    along = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][side])
    inward = np.array([-along[1], along[0]])
    half = (box[1] - box[0]) / 2 - _INNER_WALL
    spare = half @ np.abs(along) - piece[0] / 2
    if spare > 0:
        foot = box.mean(axis=0) - inward * half + along * rng.uniform(-spare, spare)
        drawing.put(foot + inward * piece[1] / 2, piece, side * math.pi / 2)
        if chair:
            seat = inward * (piece[1] + rng.uniform(0.25, 0.5))
            drawing.put(
                foot + seat + along * rng.uniform(-0.3, 0.3), (0.45, 0.45), oval=True
            )
