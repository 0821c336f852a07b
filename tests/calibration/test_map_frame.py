"""Maps of a wrong metre in a wrong place, and their way back."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.calibration import corrected, map_frame
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap, buildings
from tests.worlds import CENTRE, free_poses, l_room

SENSOR = Lidar.create(120, noise=0.01, outliers=0.05)
SCALE, SHIFT = 1.04, np.array([0.12, -0.08, 0.03])


@jax.jit
def measure(world, poses, key):
    exact = lambda pose: raycast(world, pose, SENSOR.bearings, SENSOR.range_max)
    keys = jax.random.split(key, len(poses))
    return jax.vmap(SENSOR.measure)(keys, jax.lax.map(exact, poses))


def spoilt(world, pivot):
    """The map as drawn: p where c + t + s R (p − c) should be."""
    c, s = np.cos(-SHIFT[2]), np.sin(-SHIFT[2])
    back = np.array([[c, -s], [s, c]])
    place = lambda p: (np.asarray(p) - pivot - SHIFT[:2]) @ back.T / SCALE + pivot
    if isinstance(world, PolygonMap):
        start, end = (jnp.asarray(place(p), float) for p in (world.start, world.end))
        return PolygonMap(start=start, end=end)
    origin = [*place(world.origin[:2]), float(world.origin[2]) - SHIFT[2]]
    return OccupancyGrid.from_cells(
        world.cells, float(world.resolution) / SCALE, origin
    )


def in_room(count, seed=0):
    rng = np.random.default_rng(seed)
    xy = CENTRE + rng.uniform([-1.5, -0.7], [0.7, 4], (count, 2))
    return jnp.asarray(np.column_stack([xy, rng.uniform(-3, 3, count)]), float)


def heard(poses, std, seed=1):
    """Poses as somebody reports them."""
    noise = np.random.default_rng(seed).normal(0, std, poses.shape)
    return np.asarray(poses) + noise


def off(found):
    return np.abs(np.array([found.scale, *found.shift]) - [SCALE, *SHIFT])


STD = [0.02, 0.02, 0.01]


def test_scale_and_place_of_a_polygon_map():
    poses = in_room(20)
    given = heard(poses, STD)
    drawn = spoilt(l_room(), given[:, :2].mean(axis=0))
    found = map_frame(drawn, measure(l_room(), poses, jax.random.key(0)), given, STD)
    # 20 poses of 2 cm and 0.6° leave 5 mm and 0.13°; ranges tell the scale far better.
    assert np.all(off(found) < [0.001, 0.015, 0.015, 0.008])
    assert np.all(off(found) < 3.5 * np.asarray(found.std))
    assert np.all(found.std < 0.01)
    assert np.all(found.determined)
    assert found.converged
    back = corrected(drawn, found)
    assert np.abs(np.asarray(back.start - l_room().start)).max() < 0.06


def test_scale_and_place_of_a_grid():
    cells = np.asarray(buildings.office(seed=0, width=12, height=9).cells)
    grid = OccupancyGrid.from_cells(cells, 0.05, (14.0, -9.0, 0.7))
    poses = jnp.asarray(free_poses(grid, 20, seed=3), float)
    given = heard(poses, STD)
    drawn = spoilt(grid, given[:, :2].mean(axis=0))
    found = map_frame(drawn, measure(grid, poses, jax.random.key(0)), given, STD)
    # As above; cells of 5 cm bias a wall's place by about a millimetre in 5 m.
    assert np.all(off(found) < [0.002, 0.015, 0.015, 0.008])
    assert np.all(off(found) < 3.5 * np.asarray(found.std) + [0.001, 0, 0, 0])
    assert np.all(found.determined)
    back = corrected(drawn, found)
    assert abs(float(back.resolution) - 0.05) < 1e-4
    point = jnp.asarray(poses[0, :2])
    assert abs(float(back.distance_at(point) - grid.distance_at(point))) < 0.05


def test_free_poses_tell_the_scale_alone():
    poses = in_room(12)
    scans = measure(l_room(), poses, jax.random.key(2))
    drawn = spoilt(l_room(), np.asarray(poses[:, :2]).mean(axis=0))
    found = map_frame(drawn, scans, poses, [np.inf] * 3)
    assert found.determined.tolist() == [True, False, False, False]
    assert off(found)[0] < 3.5 * found.std[0]
    assert all(np.isfinite(leaf).all() for leaf in found)


def test_a_true_map_is_left_alone():
    poses = in_room(12)
    scans = measure(l_room(), poses, jax.random.key(2))
    found = map_frame(l_room(), scans, heard(poses, STD), STD)
    still = np.array([found.scale - 1, *found.shift])
    assert np.all(np.abs(still) < 3.5 * np.asarray(found.std))


def test_shift_follows_the_frame():
    """Everything moved: the same scale, the shift about the moved pivot."""
    poses, moved = in_room(8), jnp.array([-30.0, 20.0, 0.0])
    scans = measure(l_room(), poses, jax.random.key(2))
    drawn = spoilt(l_room(), np.asarray(poses[:, :2]).mean(axis=0))
    there = PolygonMap(
        start=geometry.transform_points(moved, drawn.start),
        end=geometry.transform_points(moved, drawn.end),
    )
    here = map_frame(drawn, scans, poses, STD)
    away = map_frame(there, scans, poses + moved[None], STD)
    np.testing.assert_allclose(away.scale, here.scale, atol=2e-4)
    np.testing.assert_allclose(away.shift, here.shift, atol=1e-3)


def test_boundary():
    poses = in_room(4)
    scans = measure(l_room(), poses, jax.random.key(2))
    with pytest.raises(ValueError, match="at least 3 scans"):
        map_frame(l_room(), jax.tree.map(lambda a: a[:2], scans), poses[:2])
    with pytest.raises(ValueError, match="poses must be finite"):
        map_frame(l_room(), scans, poses[:3])
    with pytest.raises(ValueError, match="1 not finite"):
        map_frame(l_room(), scans, poses.at[1, 1].set(jnp.nan))
    with pytest.raises(ValueError, match="pose_std"):
        map_frame(l_room(), scans, poses, [0.0, 1.0, 1.0])
    blind = eqx.tree_at(lambda scans: scans.echo, scans, scans.echo & False)
    with pytest.raises(ValueError, match="scan 0 has 0 echoes"):
        map_frame(l_room(), blind, poses)
