"""`fast_match`: ten virtual scans, and as precise as physics allows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment import FastConfig, fast_match
from fsmsm_jax.evaluation.metrics import cramer_rao_bound, pose_errors
from fsmsm_jax.sensing import Lidar, Scan, panorama, raycast
from tests.worlds import CENTRE, l_room, star

ROOMS, RAYS, NOISE = 64, 180, 0.03
BOX = np.array([0.2, 0.2, np.pi / 4])
WORLDS = jax.tree.map(lambda *a: jnp.stack(a), *[star(seed) for seed in range(ROOMS)])
LIDAR = Lidar.create(RAYS, noise=NOISE)

run = jax.jit(fast_match)


@jax.jit
def run_all(worlds, scans, starts):
    """From the scans as they are; those of full circles are their own panoramas."""
    return jax.vmap(fast_match)(worlds, scans, scans, starts)


@jax.jit
def measure(world, pose, lidar, key):
    return lidar.measure(key, raycast(world, pose, lidar.bearings, lidar.range_max))


@pytest.fixture(scope="module")
def questions():
    rng = np.random.default_rng(0)
    xy = CENTRE + rng.uniform(-0.2, 0.2, (ROOMS, 2))
    true = np.column_stack([xy, rng.uniform(-np.pi, np.pi, ROOMS)])
    true = jnp.asarray(true, float)
    keys = jax.random.split(jax.random.key(0), ROOMS)
    scans = jax.vmap(measure, (0, 0, None, 0))(WORLDS, true, LIDAR, keys)
    return true, scans, true + rng.uniform(-1, 1, (ROOMS, 3)) * BOX


def test_comes_near_the_cramer_rao_bound_from_far_off(questions):
    """192 squares of one expected mean: 10 % of the root stands for 2 deviations.

    Another 10 % for what weights and kernels cost with 180 rays.
    """
    true, scans, starts = questions
    found, thickness = run_all(WORLDS, scans, starts)
    bound = jax.vmap(cramer_rao_bound, (0, 0, None, None, None))(
        WORLDS, true, LIDAR.bearings, LIDAR.range_max, NOISE
    )
    metres, radians = pose_errors(found, true)
    assert metres.max() < 0.1  # none in a wrong basin
    expected = np.sqrt(np.mean(np.asarray(bound[:, 0, 0] + bound[:, 1, 1])))
    assert 0.8 * expected < np.sqrt(np.mean(metres**2)) < 1.2 * expected
    expected = np.sqrt(np.mean(np.asarray(bound[:, 2, 2])))
    assert 0.8 * expected < np.sqrt(np.mean(radians**2)) < 1.2 * expected
    np.testing.assert_array_equal(thickness, 0)  # polygons are drawn true


def test_vmap_is_a_loop_and_jit_is_eager(questions):
    _, scans, starts = questions
    found, _ = run_all(WORLDS, scans, starts)
    for i in range(3):
        case = jax.tree.map(lambda a, i=i: a[i], (WORLDS, scans, scans, starts))
        alone, _ = run(*case)
        # Sums of 180 terms in another order, five times over.
        np.testing.assert_allclose(alone, found[i], atol=5e-5)
    eager, _ = fast_match(*case)
    np.testing.assert_allclose(eager, alone, atol=5e-5)


def test_half_a_view_by_its_panorama():
    world, lidar = l_room(), Lidar.create(RAYS, 1.5 * np.pi, noise=0.01)
    truth = jnp.asarray([*(CENTRE + [0.6, 0.3]), 2.8], float)
    scan = measure(world, truth, lidar, jax.random.key(1))
    found, _ = run(
        world, scan, panorama(scan, 240), truth + jnp.array([0.1, -0.1, 0.5])
    )
    metres, radians = pose_errors(found, truth)
    assert metres < 0.01
    assert radians < 0.005


def test_float64_is_kept_and_agrees(questions):
    _, scans, starts = questions
    case = jax.tree.map(lambda a: a[0], (WORLDS, scans, scans, starts))
    single, _ = run(*case)
    with jax.enable_x64(True):
        wide = lambda a: jnp.asarray(np.asarray(a), float if a.dtype != bool else None)
        found, _ = jax.jit(fast_match)(*jax.tree.map(wide, case))
        assert found.dtype == jnp.float64
        found = np.asarray(found)
    np.testing.assert_allclose(found, single, atol=1e-4)


def test_nothing_in_sight_leaves_finite_numbers(questions):
    _, scans, starts = questions
    world, scan, start = jax.tree.map(lambda a: a[0], (WORLDS, scans, starts))
    dark = Scan(
        ranges=jnp.full(RAYS, scan.range_max),
        bearings=scan.bearings,
        valid=jnp.zeros(RAYS, bool),
        echo=jnp.zeros(RAYS, bool),
        range_max=scan.range_max,
    )
    found, _ = run(world, dark, dark, start)
    assert jnp.isfinite(found).all()
    assert jnp.abs((found - start)[:2]).max() <= 0.27


def test_ten_scans_and_no_fewer_than_one_of_each():
    assert FastConfig().scans == 10
    with pytest.raises(ValueError, match="count from 1, got 10, 0, 1, 5"):
        FastConfig(kept=0)
