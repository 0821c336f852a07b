"""Bias, scale and noise of simulated sensors, found again."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.calibration import noise, range_correction
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap, buildings
from tests.worlds import CENTRE, free_poses, l_room

ROOM = l_room()


@eqx.filter_jit
def measure(world, poses, key, lidar):
    exact = lambda pose: raycast(world, pose, lidar.bearings, lidar.range_max)
    keys = jax.random.split(key, len(poses))
    return jax.vmap(lidar.measure)(keys, jax.lax.map(exact, poses))


def misread(scans, bias, scale):
    """The same scans by a sensor for which true range = bias + scale · reading."""
    ranges = jnp.where(scans.echo, (scans.ranges - bias) / scale, scans.ranges)
    return eqx.tree_at(lambda s: s.ranges, scans, ranges)


def in_room(count, seed=0):
    rng = np.random.default_rng(seed)
    xy = CENTRE + rng.uniform([-1.5, -0.7], [0.7, 4], (count, 2))
    return jnp.asarray(np.column_stack([xy, rng.uniform(-3, 3, count)]), float)


def nearly(poses, seed=1):
    return np.asarray(poses) + np.random.default_rng(seed).uniform(-1, 1, (3,)) * 0.05


def small_office():
    cells = np.asarray(buildings.office(seed=0, width=12, height=9).cells)
    return OccupancyGrid.from_cells(cells, 0.05, (14.0, -9.0, 0.7))


def test_bias_and_scale_in_a_polygon_room():
    poses, lidar = in_room(20), Lidar.create(120, noise=0.01, outliers=0.05)
    scans = misread(measure(ROOM, poses, jax.random.key(0), lidar), 0.06, 0.97)
    found = range_correction(ROOM, scans, nearly(poses))
    off = np.abs(np.array([found.bias - 0.06, found.scale - 0.97]))
    # 2 400 rays of 1 cm over 1 to 6 m: half a millimetre and 0.02 %, if independent.
    assert np.all(off < [0.003, 0.001])
    assert np.all(off < 3.5 * np.asarray(found.std))
    assert np.all(np.asarray(found.std) < [0.003, 0.001])
    assert np.all(found.determined)
    assert found.converged
    assert np.abs(np.asarray(found.poses - poses)[:, :2]).max() < 0.02


def test_bias_and_scale_on_a_grid():
    grid, lidar = small_office(), Lidar.create(120, noise=0.01)
    poses = jnp.asarray(free_poses(grid, 20, seed=3), float)
    scans = misread(measure(grid, poses, jax.random.key(0), lidar), 0.06, 0.97)
    found = range_correction(grid, scans, nearly(poses))
    # Cells of 5 cm: a bias of a tenth of one is as much as their faces allow.
    assert abs(found.bias - 0.06) < 0.006
    assert abs(found.scale - 0.97) < 0.002


def test_in_the_middle_of_a_round_room_bias_and_scale_are_one():
    angles = 2 * np.pi * np.arange(180) / 180
    circle = CENTRE + 3 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    world = PolygonMap.from_outlines(circle)
    poses = jnp.tile(jnp.asarray([*CENTRE, 0.5], float), (4, 1))
    scans = measure(world, poses, jax.random.key(0), Lidar.create(120, noise=0.01))
    found = range_correction(world, scans, poses)
    assert not np.any(found.determined)
    assert abs(found.bias + 3 * found.scale - 3) < 0.01
    assert all(np.isfinite(leaf).all() for leaf in found)


@pytest.mark.parametrize(("sigma", "outliers"), [(0.03, 0.0), (0.03, 0.1), (0.1, 0.05)])
def test_noise_in_a_polygon_room(sigma, outliers):
    poses = in_room(25)
    lidar = Lidar.create(120, noise=sigma, outliers=outliers)
    found = noise(ROOM, measure(ROOM, poses, jax.random.key(5), lidar), nearly(poses))
    # 3 000 rays leave 1.3 %; rays at the corner change walls and cost as much again.
    assert abs(found.sigma - sigma) < 0.05 * sigma
    assert 0.01 < found.std / sigma < 0.02
    assert abs(found.outliers - outliers) < 0.03
    assert found.converged


def test_freedom_spent_on_poses_is_given_back():
    """With 12 rays a scan, 3 of 12 are the pose's: 13 % less without the correction."""
    poses = in_room(300)
    lidar = Lidar.create(12, noise=0.02)
    found = noise(
        ROOM, measure(ROOM, poses, jax.random.key(6), lidar), np.asarray(poses)
    )
    assert abs(found.sigma - 0.02) < 0.06 * 0.02


def test_noise_on_a_grid_includes_its_cells():
    grid, lidar = small_office(), Lidar.create(120, noise=0.03)
    poses = jnp.asarray(free_poses(grid, 20, seed=3), float)
    found = noise(grid, measure(grid, poses, jax.random.key(0), lidar), nearly(poses))
    assert 0.028 < found.sigma < 0.036


def test_boundary():
    poses, lidar = in_room(4), Lidar.create(120)
    scans = measure(ROOM, poses, jax.random.key(0), lidar)
    for function in (range_correction, noise):
        with pytest.raises(ValueError, match="at least 3 scans"):
            function(ROOM, jax.tree.map(lambda a: a[:2], scans), poses[:2])
        with pytest.raises(ValueError, match="poses must be finite"):
            function(ROOM, scans, poses * jnp.nan)
        with pytest.raises(ValueError, match="stacked"):
            function(ROOM, jax.tree.map(lambda a: a[0], scans), poses[0])
