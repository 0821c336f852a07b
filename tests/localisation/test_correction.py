"""The search for the pose around a prediction: how wide, how sharp, how repeatable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation.correction import CorrectionConfig, correct, deviation
from fsmsm_jax.sensing import raycast
from tests.localisation.simulated import LIDAR, NOISE, blind, error, office, part
from tests.worlds import CENTRE, free_poses, l_room

LOOSE = jnp.diag(jnp.array([0.15, 0.15, 0.08]) ** 2)  # starts ±0.3 m, ±9° beside it
TIGHT = jnp.diag(jnp.array([0.02, 0.02, 0.01]) ** 2)
TRUE_MAP = jnp.asarray(0.01)


def standing(world, poses, clear=0.4):
    poses = jnp.asarray(poses, float)
    return poses[np.asarray(world.distance_at(poses[:, :2])) > clear][:12]


@jax.jit
def seen(world, poses):
    exact = lambda pose: raycast(world, pose, LIDAR.bearings, LIDAR.range_max)
    keys = jax.random.split(jax.random.key(0), len(poses))
    return jax.vmap(LIDAR.measure)(keys, jax.lax.map(exact, poses))


@jax.jit
def one(world, scan, predicted, covariance, usual, config=CorrectionConfig()):
    """No other starts than the lattice, but the prediction thrice."""
    others = jnp.broadcast_to(predicted, (3, 3))
    return correct(world, scan, predicted, covariance, others, usual, config)


all_of = jax.jit(jax.vmap(one, (None, 0, 0, None, None)))


@pytest.fixture(scope="module", params=["office", "polygons"])
def places(request):
    """A world, twelve poses in it and what is seen from there."""
    if request.param == "office":
        world = office()
        poses = standing(world, free_poses(world, 120, 3))
    else:
        world = l_room()
        rng = np.random.default_rng(0)
        offs = rng.uniform([-1.5, -0.6, -3.1], [3.5, 1.0, 3.1], (60, 3))
        poses = standing(world, np.array([*CENTRE, 0.0]) + offs)
    assert len(poses) == 12
    return world, poses, seen(world, poses)


def around(count, distance, turn, seed=0):
    """Errors of predictions: so far away in all directions, turned to either side."""
    rng = np.random.default_rng(seed)
    way = rng.uniform(-np.pi, np.pi, count)
    turns = rng.choice([-turn, turn], count)
    return np.column_stack([distance * np.cos(way), distance * np.sin(way), turns])


@pytest.mark.parametrize(("distance", "turn"), [(0.0, 0.0), (0.2, 0.08), (0.45, 0.2)])
def test_the_pose_is_found(places, distance, turn):
    """Starts reach 0.3 m in x and in y; from there a descent pulls as far again.

    180 rays of 1 cm noise know the pose to 1 mm; five of them are allowed.
    """
    world, poses, scans = places
    predicted = poses + around(12, distance, turn)
    pose, thickness, off = all_of(world, scans, predicted, LOOSE, TRUE_MAP)
    away, turned = error(pose, poses)
    right = (away < 5e-3) & (turned < np.deg2rad(0.3))
    assert right.mean() >= (1 if distance < 0.3 else 0.9)
    assert np.abs(np.asarray(thickness)[right]).max() < 0.03
    assert (np.asarray(off)[right] < 0.1).all()


def test_slipped_odometry(places):
    """15 of its standard deviations off: the prior has levelled off by then."""
    world, poses, scans = places
    predicted = poses + around(12, 0.3, 0.05, seed=1)
    pose, *_ = all_of(world, scans, predicted, TIGHT, TRUE_MAP)
    assert (error(pose, poses)[0] < 5e-3).mean() >= 0.9


def test_other_starts_find_what_the_lattice_does_not_reach(places):
    world, poses, scans = places
    found = 0
    for n in range(4):
        predicted = poses[n] + jnp.asarray([0.9, -0.9, 1.5])
        others = poses[n][None] + jnp.asarray(around(3, 0.1, 0.05), float)
        pose, *_ = with_others(world, part(scans, n), predicted, TIGHT, others)
        found += error(pose, poses[n])[0] < 5e-3
    assert found >= 3


@jax.jit
def with_others(world, scan, predicted, covariance, others):
    return correct(world, scan, predicted, covariance, others, TRUE_MAP)


def test_a_wrong_map_gets_no_finish_by_ranges(places):
    """No thickness is estimated then, and the pose is what end points know of it."""
    world, poses, scans = places
    scan = part(scans, 0)
    ask = lambda usual, wrong: one(
        world, scan, poses[0], LOOSE, jnp.asarray(usual), CorrectionConfig(wrong=wrong)
    )
    sharp, barely, off = ask(0.01, 0.2), ask(0.14, 0.1401), ask(0.14, 0.1399)
    for a, b in zip(sharp, barely, strict=True):
        np.testing.assert_array_equal(a, b)  # both deviate by less than the blur
    assert off[1] == 0.0
    assert not np.array_equal(sharp[0], off[0])
    np.testing.assert_array_equal(sharp[2], off[2])  # it is taken before the finish
    assert error(off[0], poses[0])[0] < 0.05


def test_the_finish_stays_within_reach(places):
    """Metres of the settings are leaves: another number is no other program."""
    world, poses, scans = places
    scan, predicted = part(scans, 1), poses[1] + jnp.asarray([0.2, 0.1, 0.1])
    never = CorrectionConfig(wrong=0.0)
    unfinished, *_ = one(world, scan, predicted, LOOSE, TRUE_MAP, never)
    pose, *_ = one(world, scan, predicted, LOOSE, TRUE_MAP)
    bound = CorrectionConfig(reach=1e-4)
    held, *_ = one(world, scan, predicted, LOOSE, TRUE_MAP, bound)
    assert np.abs(np.asarray(pose - unfinished))[:2].max() > 1e-4
    assert np.abs(np.asarray(held - unfinished))[:2].max() < 1.1e-4


def test_again_and_alone_it_says_the_same(places):
    """Alone and under vmap, sums are taken in another order: a tenth of the noise."""
    world, poses, scans = places
    predicted = poses + around(12, 0.1, 0.05)
    first = all_of(world, scans, predicted, LOOSE, TRUE_MAP)
    again = all_of(world, scans, predicted, LOOSE, TRUE_MAP)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    for n in (0, 5, 11):
        alone = one(world, part(scans, n), predicted[n], LOOSE, TRUE_MAP)
        np.testing.assert_allclose(alone[0], first[0][n], atol=NOISE / 10)
        np.testing.assert_allclose(alone[1], first[1][n], atol=NOISE / 10)


def test_headings_across_pi_are_near(places):
    """A prediction of 3.1 for a heading of −3.1 is 0.08 off, not 6.2."""
    world, poses, _ = places
    wrapped = poses.at[:, 2].set(-3.1)
    scans = seen(world, wrapped)
    pose, *_ = all_of(world, scans, wrapped.at[:, 2].set(3.1), TIGHT, TRUE_MAP)
    away, turned = error(pose, wrapped)
    assert away.max() < 5e-3
    assert turned.max() < np.deg2rad(0.3)
    assert (np.abs(np.asarray(pose[:, 2])) <= np.pi).all()


def test_a_blind_scan_gives_numbers(places):
    world, poses, scans = places
    scan = part(scans, 0)
    found = one(world, blind(scan), poses[0], LOOSE, TRUE_MAP)
    assert all(np.isfinite(part).all() for part in found)
    assert error(found[0], poses[0])[0] < 1e-4


def test_deviation_is_the_noise(places):
    """Of the median, of 180 rays: to a third. A pose that is off deviates by more."""
    world, poses, scans = places
    measure = jax.jit(jax.vmap(deviation, (None, 0, 0)))
    here = np.median(measure(world, scans, poses))
    assert NOISE * 2 / 3 < here < 3 * NOISE  # a grid's cells are 5 cm wide
    beside = jax.vmap(geometry.compose, (0, None))(poses, jnp.asarray([0.2, 0.2, 0.1]))
    assert np.median(measure(world, scans, beside)) > 4 * here
