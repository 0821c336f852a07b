"""Small worlds to test in, all of them away from the origin.

At the origin a forgotten translation, a swapped frame or a lost yaw is invisible, so
nothing here stands there, and no grid is parallel to the map's axes.
"""

import numpy as np

from fsmsm_jax.world import OccupancyGrid, PolygonMap

CENTRE = np.array([12.5, -7.25])
"""A free position [m] in each of the polygon worlds."""


def square_room(side: float = 4.0) -> PolygonMap:
    """A convex room around `CENTRE`: every ray's range is smooth in the pose."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2
    return PolygonMap.from_outlines(corners + CENTRE)


def l_room() -> PolygonMap:
    """Six walls and one corner to hide behind; no symmetry."""
    corners = [[-2, -1], [4, -1], [4, 1.5], [1, 1.5], [1, 5], [-2, 5]]
    return PolygonMap.from_outlines(np.array(corners) + CENTRE)


def star(seed: int, corners: int = 24) -> PolygonMap:
    """A jagged room around `CENTRE`, 1 to 6 m deep."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(corners) + rng.uniform(0, 0.8, corners)) / corners
    radii = rng.uniform(1, 6, corners)
    outline = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return PolygonMap.from_outlines(outline + CENTRE)


def random_cells(seed: int, height: int, width: int) -> np.ndarray:
    """ROS cells: scattered boxes and thin walls, an unknown patch, open borders."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((height, width), int)
    for _ in range(height * width // 400):
        row, column = rng.integers(0, height), rng.integers(0, width)
        tall, wide = rng.integers(1, [[2, 12], [12, 2], [6, 6]][rng.integers(3)])
        cells[row : row + tall, column : column + wide] = 100
    row, column = rng.integers(0, height // 2), rng.integers(0, width // 2)
    patch = cells[row : row + height // 5, column : column + width // 5]
    patch[patch == 0] = -1
    return cells


def random_grid(seed: int, height: int = 90, width: int = 130, **options):
    """A grid of `random_cells`, turned and shifted in the map."""
    rng = np.random.default_rng(seed + 1000)
    origin = (rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-3, 3))
    cells = random_cells(seed, height, width)
    return OccupancyGrid.from_cells(cells, 0.05, origin, **options)


def rasterised_room(yaw: float, side: float = 6.0, resolution: float = 0.05):
    """A square room painted on a grid, its walls at `yaw` to the grid's axes.

    Returns the grid and the same room as a `PolygonMap`. The painted wall starts at
    the true wall, so that ranges agree within a cell.
    """
    size = int(2 * side / resolution)
    origin = np.array([*(CENTRE - [3, 5]), 0.4])
    turn = lambda a: np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    row, column = np.mgrid[:size, :size]
    local = (np.stack([column, row], axis=-1) + 0.5 - size / 2) * resolution
    x, y = np.moveaxis(np.abs(local @ turn(yaw)), -1, 0)
    cells = np.where(np.maximum(x, y) > side / 2, 100, 0)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2
    outline = (corners @ turn(yaw).T + size * resolution / 2) @ turn(origin[2]).T
    return (
        OccupancyGrid.from_cells(cells, resolution, tuple(origin)),
        PolygonMap.from_outlines(outline + origin[:2]),
    )


def free_poses(grid: OccupancyGrid, count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) random poses in free cells of a grid, map frame, float64."""
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(np.asarray(grid.free))
    pick = rng.integers(0, rows.size, count)
    cells = np.stack([columns[pick], rows[pick]], axis=-1) + rng.uniform(
        0.05, 0.95, (count, 2)
    )
    x, y, yaw = np.asarray(grid.origin, float)
    local = cells * float(grid.resolution)
    c, s = np.cos(yaw), np.sin(yaw)
    xy = np.stack(
        [x + c * local[:, 0] - s * local[:, 1], y + s * local[:, 0] + c * local[:, 1]],
        axis=-1,
    )
    return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])
