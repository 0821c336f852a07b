"""Scans with noise, starts beside the truth, and a small office to do it in."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from fsmsm_jax import geometry
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid, buildings
from tests.worlds import CENTRE, free_poses

NOISE = 0.01
SENSOR = Lidar.create(180, noise=NOISE)
POSE = jnp.asarray([*(CENTRE + [0.4, -0.3]), 0.6], float)

cast = jax.jit(raycast)


@jax.jit
def measure(world, lidar, poses, key):
    """One scan a pose; one after the other, as a vmapped march compiles long."""
    exact = lambda pose: raycast(world, pose, lidar.bearings, lidar.range_max)
    keys = jax.random.split(key, len(poses))
    return jax.vmap(lidar.measure)(keys, jax.lax.map(exact, poses))


def perturbed(poses, metres, radians, seed=0):
    """Starts at exactly that distance, in random directions, turned at most so far."""
    rng = np.random.default_rng(seed)
    way, turn = rng.uniform(-np.pi, np.pi, len(poses)), rng.uniform(-1, 1, len(poses))
    offset = [metres * np.cos(way), metres * np.sin(way), radians * turn]
    return poses + jnp.asarray(np.stack(offset, axis=1), float)


def errors(found, true):
    """Distances [m] and absolute heading differences [rad]."""
    off = np.asarray(found - true, float)
    turn = np.asarray(geometry.wrap(found[..., 2] - true[..., 2]), float)
    return np.hypot(off[..., 0], off[..., 1]), np.abs(turn)


def walls(world):
    return np.asarray(world.start, float), np.asarray(world.end, float)


def small_office(thicken=False):
    """A 12 m × 9 m office, turned and away from the origin."""
    cells = np.asarray(buildings.office(seed=0, width=12, height=9).cells)
    if thicken:
        wider = ndimage.binary_dilation(cells >= 50, np.ones((3, 3)))
        cells = np.where(wider, 100, cells)
    return OccupancyGrid.from_cells(cells, 0.05, (20.0, -30.0, 0.7))


def office_poses(world, count, clearance=0.4):
    poses = jnp.asarray(free_poses(world, 8 * count, seed=1), float)
    clear = world.distance_at(poses[:, :2]) > clearance
    assert clear.sum() >= count
    return poses[clear][:count]


def room_poses(count):
    """Poses in `l_room`, 0.6 m clear of its walls, all headings."""
    rng = np.random.default_rng(0)
    around = rng.uniform([-0.9, -0.4], [2.5, 0.9], (count, 2))
    poses = np.column_stack([around + CENTRE, np.linspace(-3, 3, count)])
    return jnp.asarray(poses, float)


def few_rays(world, count):
    """A scan from `POSE` of which only so many rays are valid."""
    exact = cast(world, POSE, SENSOR.bearings)
    seen = jnp.arange(180) % 7 == 3
    seen = seen & (jnp.cumsum(seen) <= count)
    ranges = jnp.where(seen, exact, SENSOR.range_max)
    return Scan(ranges, SENSOR.bearings, seen, seen, SENSOR.range_max)


def assert_same(one, other, rtol, atol):
    """Sums of 180 float32 terms in another order differ by a few times 180 × 6e-8."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


def in_double(tree):
    """The same numbers as float64; call it under `jax.enable_x64(True)`."""
    double = lambda a: jnp.asarray(a, np.float64 if a.dtype == np.float32 else None)
    return jax.tree.map(double, tree)
