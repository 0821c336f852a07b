import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.world import OccupancyGrid, occupancy
from tests.worlds import random_cells, random_grid


def test_three_kinds_of_cells_are_kept_apart():
    grid = OccupancyGrid.from_cells(
        [[0, 49, 50], [100, -1, 10]], 0.1, (5, -3, 1), unknown="opaque"
    )
    kinds = np.stack([grid.free, grid.occupied, grid.unknown]).astype(int)
    np.testing.assert_array_equal(kinds.sum(axis=0), 1)
    np.testing.assert_array_equal(grid.occupied, [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(grid.unknown, [[0, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize("unknown", ["transparent", "opaque"])
def test_clearance_is_the_chessboard_distance_to_what_stops_rays(unknown):
    cells = random_cells(1, 23, 31)
    grid = OccupancyGrid.from_cells(cells, 0.1, (5, -3, 1), unknown=unknown)
    stops = (cells >= 50) | ((cells < 0) & (unknown == "opaque"))
    rows, columns = np.nonzero(np.pad(stops, 1, constant_values=True))
    row, column = np.mgrid[:25, :33]
    expected = np.maximum(
        np.abs(row[..., None] - rows), np.abs(column[..., None] - columns)
    ).min(axis=-1)
    np.testing.assert_array_equal(grid.clearance, expected)


def test_distance_is_euclidean_between_centres():
    grid = random_grid(2, 23, 31)
    rows, columns = np.nonzero(np.asarray(grid.occupied))
    row, column = np.mgrid[:23, :31]
    expected = np.hypot(row[..., None] - rows, column[..., None] - columns).min(axis=-1)
    np.testing.assert_allclose(grid.distance, 0.05 * expected, rtol=1e-6)


def test_empty_map_is_far_from_everything():
    grid = OccupancyGrid.from_cells(np.zeros((6, 8), int), 0.5, (5, -3, 1))
    np.testing.assert_allclose(grid.distance, 5.0)
    assert abs(grid.slope).max() == 0


def test_a_huge_empty_map_keeps_a_safe_clearance():
    grid = OccupancyGrid.from_cells(np.zeros((600, 600), int), 0.05, (5, -3, 1))
    assert grid.clearance.max() == 255  # capped, not wrapped around uint8


@pytest.mark.parametrize("unknown", ["transparent", "opaque"])
def test_large_maps_are_made_in_bands_without_a_seam(monkeypatch, unknown):
    whole = random_grid(6, 90, 60, unknown=unknown)
    monkeypatch.setattr(occupancy, "_BAND", 16)
    jax.tree.map(
        np.testing.assert_array_equal, random_grid(6, 90, 60, unknown=unknown), whole
    )
    monkeypatch.setattr(occupancy, "_BAND", 200)  # from 255 cells on, all is far
    open_space = OccupancyGrid.from_cells(np.zeros((620, 600), int), 0.1)
    row, column = np.mgrid[:622, :602]
    to_edge = np.minimum(np.minimum(row, 621 - row), np.minimum(column, 601 - column))
    np.testing.assert_array_equal(open_space.clearance, np.minimum(to_edge, 255))


def test_slopes_rise_into_the_wall():
    cells = np.zeros((20, 20), int)
    cells[:, 12:] = 100
    slope = np.asarray(OccupancyGrid.from_cells(cells, 0.05, (5, -3, 1)).slope)
    assert np.abs(slope[..., 1]).max() < 1e-6  # nothing changes from row to row
    assert slope[10, 5, 0] < 0.01 < 0.3 < slope[10, 11, 0]
    np.testing.assert_allclose(slope[10, 11, 0], slope[10, 12, 0], rtol=1e-4)


def test_cells_and_map_frame_with_yaw():
    grid = OccupancyGrid.from_cells(
        np.zeros((20, 30), int), 0.5, (10.0, -4.0, np.pi / 2)
    )
    # Turned by 90°, columns run along +y of the map and rows along −x.
    np.testing.assert_allclose(grid.to_map(jnp.array([2.0, 0.0])), [10, -3], atol=1e-5)
    np.testing.assert_allclose(grid.to_map(jnp.array([0.0, 4.0])), [8, -4], atol=1e-5)
    points = jnp.array([[[3.0, 5.0], [-2.0, 7.0]]])
    np.testing.assert_allclose(grid.to_map(grid.to_cells(points)), points, atol=1e-5)


def test_grids_are_pytrees_of_arrays_and_keep_precision():
    grid = random_grid(3, 23, 31)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(grid))
    assert jax.jit(lambda g: g.free.sum())(grid) == grid.free.sum()
    with jax.enable_x64(True):
        assert random_grid(3, 23, 31).to_map(jnp.ones(2)).dtype == jnp.float64


CELLS = np.zeros((3, 4), int)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cells": np.zeros(5, int)}, r"\(height, width\) array, got \(5,\)"),
        ({"cells": np.zeros((0, 3), int)}, "non-empty"),
        ({"cells": CELLS + 101}, "must lie in"),
        ({"cells": CELLS - 2}, "must lie in"),
        ({"cells": CELLS * np.nan}, "must lie in"),
        ({"resolution": 0.0}, "positive number of metres, got 0"),
        ({"resolution": -0.05}, "positive"),
        ({"resolution": np.nan}, "positive"),
        ({"origin": (0.0, 0.0)}, "three finite numbers"),
        ({"origin": (0.0, np.nan, 0.0)}, "three finite numbers"),
        ({"unknown": "free"}, "'transparent' or 'opaque', got 'free'"),
    ],
)
def test_bad_grids_are_refused(arguments, message):
    good = {"cells": CELLS, "resolution": 0.05, "origin": (1.0, 2.0, 3.0)}
    with pytest.raises(ValueError, match=message):
        OccupancyGrid.from_cells(**(good | arguments))
