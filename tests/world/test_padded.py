"""A padded map is the same map: for rays, distances and points, on it and off it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.localisation.likelihood import log_likelihoods
from fsmsm_jax.sensing import Scan, raycast_with_jacobian
from fsmsm_jax.world import load_map, save_map
from fsmsm_jax.world.sizes import bucket
from tests.worlds import free_poses, random_grid

BEARINGS = jnp.arange(-12, 12) * jnp.pi / 12
SCAN = Scan.from_bearings(np.full(24, 2.0), np.asarray(BEARINGS))


@pytest.fixture(scope="module", params=["transparent", "opaque"])
def maps(request):
    grid = random_grid(4, 83, 131, unknown=request.param)
    return grid, grid.padded()


def around(grid, seed=0, count=30):
    """Points on the map, on its edges, in its corners, in what was added, and beyond."""
    height, width = grid.cells.shape
    cells = np.random.default_rng(seed).uniform(
        -20, [width + 20, height + 20], (count, 2)
    )
    edges = [
        [x, y]
        for x in (0.0, 1.0, width / 2, width - 1, width)
        for y in (0.0, 1.0, height - 1, height)
    ]
    return grid.to_map(jnp.asarray(np.concatenate([cells, edges]), float))


def test_sides_share_buckets_and_the_map_keeps_its_extent(maps):
    grid, padded = maps
    assert padded.cells.shape == (bucket(83), bucket(131)) == (88, 144)
    assert grid.extent == (83, 131)
    assert [int(side) for side in padded.extent] == [83, 131]
    assert padded.clearance.shape == (90, 146)
    again = padded.padded()
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(padded)))
    other = random_grid(5, 87, 140).padded()
    assert jax.tree.structure(other) == jax.tree.structure(padded)
    assert jax.tree.map(jnp.shape, other) == jax.tree.map(jnp.shape, padded)
    fits = random_grid(5, 88, 144).padded()  # nothing to add, and yet of the same kind
    assert jax.tree.map(jnp.shape, fits) == jax.tree.map(jnp.shape, padded)


def test_what_was_added_is_neither_free_nor_occupied(maps):
    grid, padded = maps
    for kind in ("free", "occupied"):
        assert getattr(padded, kind).sum() == getattr(grid, kind).sum()


@jax.jit
def look(grid, poses):
    """All that a map is asked: ranges and their derivatives, and what is at a place."""
    cast = lambda pose: raycast_with_jacobian(grid, pose, BEARINGS, 4.0)
    points = poses[:, :2]
    return {
        "cast": jax.vmap(cast)(poses),
        "distance": grid.distance_at(points),
        "pull": jax.vmap(jax.grad(grid.distance_at))(points),
        "contains": grid.contains(points),
        "unknown": grid.unknown_at(points),
        "particles": log_likelihoods(grid, SCAN, poses),
    }


def test_rays_and_points_on_and_off_the_map_are_the_same(maps):
    grid, padded = maps
    inside = jnp.asarray(free_poses(grid, 35), float)
    # Corners and edges look along the grid's axes and diagonals, over the edge.
    outside = jnp.pad(around(grid), ((0, 0), (0, 1)), constant_values=grid.origin[2])
    poses = jnp.concatenate([inside, outside])
    expected, found = look(grid, poses), look(padded, poses)
    ranges = np.asarray(expected["cast"][0])[:35]
    assert (ranges < 4.0).mean() > 0.2, "few rays hit: says nothing"
    assert (ranges == 4.0).mean() > 0.02, "no ray leaves the map: says nothing"
    assert 0.1 < expected["contains"].mean() < 0.9
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_lattices_are_the_same(maps):
    expected, found = (lattice_over(grid, 0.2, 0.5) for grid in maps)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_saved_maps_are_of_the_map_alone(maps, tmp_path):
    grid, padded = maps
    save_map(padded, tmp_path / "map.yaml")
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, grid.cells)


def test_maps_of_about_a_size_share_a_program():
    traced = []

    @jax.jit
    def area(grid):
        traced.append(grid.cells.shape)
        return grid.free.sum() * grid.resolution**2

    for seed, sides in enumerate([(83, 131), (81, 144), (88, 130)]):
        area(random_grid(seed, *sides).padded())
    assert traced == [(88, 144)]
