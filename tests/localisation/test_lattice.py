"""Where a sensor may stand: in free space and a little beyond, on every kind of map."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.world import OccupancyGrid
from tests.oracles.raycast import cast_walls
from tests.worlds import l_room, random_grid

SPACING, MARGIN = 0.5, 0.3


@pytest.fixture(scope="module")
def grid():
    """Turned, shifted, with an unknown patch."""
    world = random_grid(3, 70, 100)
    assert np.asarray(world.unknown).any()
    return world


def nodes_of(lattice, allowed):
    """(rows, columns, 2) map-frame positions of all nodes."""
    row, column = (jnp.asarray(i) for i in np.indices(allowed.shape))
    return np.asarray(lattice.to_map(row, column))


def cells_of(grid, points):
    """(column, row) of map-frame points, by hand and in float64."""
    x, y, yaw = np.asarray(grid.origin, float)
    off = np.asarray(points, float) - [x, y]
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]])
    return np.floor(local.T / float(grid.resolution)).astype(int)


@pytest.mark.parametrize("margin", [0.0, MARGIN, 2.0])
def test_positions_stand_in_or_near_free_space(grid, margin):
    """On a turned grid: near is half a spacing, or the margin where nothing is known."""
    lattice, allowed = lattice_over(grid, SPACING, margin)
    column, row = cells_of(grid, nodes_of(lattice, allowed)[allowed]).T
    free, unknown = np.asarray(grid.free), np.asarray(grid.unknown)
    height, width = free.shape
    assert ((column >= 0) & (column < width) & (row >= 0) & (row < height)).all()
    gap = KDTree(np.argwhere(free)).query(np.stack([row, column], axis=1))[0] * 0.05
    reach = np.where(unknown[row, column], max(margin, 0.25), 0.25)
    assert (gap <= reach + 1e-6).all()
    assert (gap == 0).mean() > 0.5  # most stand on a free cell itself
    if margin > 1:  # the unknown patch is 0.7 m by 1 m: all of it is within the margin
        assert (gap > 0.25).any()


def test_no_node_on_a_free_cell_is_left_out(grid):
    lattice, allowed = lattice_over(grid, SPACING, MARGIN)
    nodes = nodes_of(lattice, allowed).reshape(-1, 2)
    j, i = cells_of(grid, nodes).T
    height, width = grid.cells.shape
    on_map = (j >= 0) & (j < width) & (i >= 0) & (i < height)
    i, j = np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)
    on_free = (on_map & np.asarray(grid.free)[i, j]).reshape(allowed.shape)
    assert on_free.any()
    assert allowed[on_free].all()
    # And the lattice leaves no known cell farther away than half its diagonal.
    known = np.argwhere(np.asarray(grid.free | grid.occupied)) + 0.5
    x, y = np.asarray(grid.to_map(jnp.asarray(known[:, ::-1], float))).T
    gap = KDTree(nodes).query(np.stack([x, y], axis=1))[0]
    assert gap.max() < SPACING / np.sqrt(2) + 0.05


def test_nodes_are_one_spacing_apart_and_turned_with_the_map(grid):
    lattice, _ = lattice_over(grid, SPACING, MARGIN)
    at = lambda r, c: np.asarray(lattice.to_map(jnp.asarray(r), jnp.asarray(c)))
    yaw = float(grid.origin[2])
    along = SPACING * np.array([np.cos(yaw), np.sin(yaw)])
    up = SPACING * np.array([-np.sin(yaw), np.cos(yaw)])
    np.testing.assert_allclose(at(3, 5) - at(3, 4), along, atol=1e-5)
    np.testing.assert_allclose(at(4, 4) - at(3, 4), up, atol=1e-5)


def test_polygon_positions_lie_inside():
    """The L-room is 25.5 m² large: some 102 nodes of a half-metre lattice fall inside."""
    world = l_room()
    lattice, allowed = lattice_over(world, SPACING, 0.0)
    inside = np.asarray(nodes_of(lattice, allowed)[allowed], float)
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    angles = 2 * np.pi * np.arange(3) / 3 + 0.1
    for place in inside:  # whoever is inside meets walls all around, and near
        assert cast_walls(start, end, place, angles, 50.0).max() < 10
    area = 6 * 2.5 + 3 * 3.5
    assert abs(len(inside) - area / SPACING**2) <= 12  # half a node an edge


def test_arrays_that_are_larger_than_the_map_change_nothing(grid):
    padded = grid.padded()
    assert padded.cells.shape != grid.cells.shape
    lattice, allowed = lattice_over(grid, SPACING, 2.0)
    same_lattice, same_allowed = lattice_over(padded, SPACING, 2.0)
    np.testing.assert_array_equal(same_allowed, allowed)
    np.testing.assert_array_equal(same_lattice.frame, lattice.frame)


@pytest.mark.parametrize("value", [100, -1])
def test_a_map_without_free_space_is_refused(value):
    world = OccupancyGrid.from_cells(np.full((20, 30), value), 0.05, (3.0, 4.0, 0.5))
    with pytest.raises(ValueError, match="free|known"):
        lattice_over(world, SPACING, MARGIN)


@pytest.mark.parametrize("kind", ["grid", "polygon"])
def test_too_coarse_a_lattice_is_refused(kind, grid):
    """Its one node would stand 25 m beside the map, where nothing is known."""
    world = grid if kind == "grid" else l_room()
    with pytest.raises(ValueError, match="spacing"):
        lattice_over(world, 50.0, 1.0)
