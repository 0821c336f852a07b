"""PGL-FMIC in two rooms with a door between them, with small pictures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.fmi_spomf import FmiConfig
from fsmsm_jax.localisation.pgl_fmic import PglFmicConfig, pgl_fmic
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import PolygonMap
from tests.localisation.simulated import error
from tests.worlds import CENTRE

RAYS, REACH, NOISE = 180, 10.0, 0.01
LIDAR = Lidar.create(RAYS, range_max=REACH, noise=NOISE)
REGISTRATION = FmiConfig(64, 32, candidates=1, kept=1, largest_scale=1.2)
SMALL = PglFmicConfig(size=64, rays=RAYS, finalists=8, registration=REGISTRATION)
BY_CENTROIDS = PglFmicConfig(
    size=64,
    rays=RAYS,
    registration=FmiConfig(64, 32, candidates=1, kept=1),
    move="centroid",
    steps=10,
    tries=1,
    finalists=1,
    rounds=1,
)
PIXEL = 2.5 * 7 / 64  # [m]: no corner is farther than some 7 m
WEST = [[-3, -2], [1, -2], [1, 0], [1.2, 0], [1.2, -1], [5, -1]]
EAST = [[5, 3.5], [1.2, 3.5], [1.2, 1], [1, 1], [1, 1.4], [-1.5, 1.4]]
WORLD = PolygonMap.from_outlines(
    np.array([*WEST, *EAST, [-1.5, 2.4], [-3, 2.4]]) + CENTRE
)
POSE = np.array([*(CENTRE + [-1.2, 0.3]), 2.1])
PLACES = [[-1.2, 0.3, 2.1], [3.4, 0.8, -2.8], [1.1, 0.6, 0.3], [1.7, 0.5, -1.0]]
"""In either room, in the door, and beside it; about `CENTRE`."""


@jax.jit
def measure(world, pose, key):
    return LIDAR.measure(key, raycast(world, pose, LIDAR.bearings, REACH))


def scan_of(world, pose, seed=0):
    return measure(world, jnp.asarray(pose, jnp.float32), jax.random.key(seed))


def localised(world, scan, seed=0, config=SMALL):
    return pgl_fmic(jax.random.key(seed), world, scan, 24, config)


@pytest.mark.parametrize("place", PLACES)
def test_a_place_is_found(place):
    pose = place + np.array([*CENTRE, 0])
    found = localised(WORLD, scan_of(WORLD, pose))
    away, turned = error(found.pose, pose)
    assert bool(found.converged)
    # A shift is read to a fraction of a pixel, an angle to a fraction of 180°/64.
    assert away < PIXEL / 2
    assert turned < np.deg2rad(180 / 64)


def test_by_centroids_as_the_thesis_does_it():
    """Right at times: one draw of 24, one round. In a room, here, three times of four."""
    scan = scan_of(WORLD, POSE)
    found = [localised(WORLD, scan, seed, BY_CENTROIDS) for seed in range(4)]
    away = np.array([error(f.pose, POSE)[0] for f in found])
    assert np.sum(away < 0.5) >= 3
    assert {f.finalists.poses.shape for f in found} == {(1, 3)}


def test_the_record_says_how_each_hypothesis_fared():
    found = localised(WORLD, scan_of(WORLD, POSE))
    assert found.hypotheses.shape == (24, 3)
    assert bool(WORLD.contains(found.hypotheses[:, :2]).all())
    w = np.asarray(found.similarities)
    assert ((w >= 0) & (w <= 1)).all()
    assert (np.abs(np.log(found.scale)) <= np.log(1.3)).all()
    # Of 8 finalists a quarter goes through; the best of them is the answer.
    assert found.finalists.poses.shape == (2, 3)
    best = np.argmax(found.finalists.similarity)
    np.testing.assert_array_equal(found.finalists.poses[best], found.pose)
    # From where the scan was taken, more alike than from anywhere else.
    assert float(found.similarity) > w.max()


def test_hypotheses_keep_their_distance():
    scan = scan_of(WORLD, POSE)

    def closest(config):
        xy = np.asarray(localised(WORLD, scan, 3, config).hypotheses)[:, :2]
        apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
        return np.min(apart + 9 * np.eye(24))

    # 24 in 33 m²: on a square lattice 1.2 m apart; two of 24 drawn freely nearly meet.
    assert closest(SMALL) > 0.4
    assert closest(BY_CENTROIDS) < 0.3


def test_no_confident_answer_where_there_is_none():
    b = np.asarray(LIDAR.bearings, float)
    elsewhere = 1.5 + 0.7 * np.cos(3 * b) + 0.5 * np.sin(7 * b)  # no such room
    stranger = Scan.from_bearings(elsewhere, b, range_max=REACH)
    found = localised(WORLD, stranger)
    assert not bool(found.converged)
    shut = PglFmicConfig(
        size=64,
        rays=RAYS,
        finalists=8,
        registration=REGISTRATION,
        smallest_scale=5.0,
        largest_scale=6.0,
    )
    refused = localised(WORLD, scan_of(WORLD, POSE), config=shut)
    assert not bool(refused.converged)
    assert float(refused.similarity) == 0
    assert (np.asarray(refused.finalists.similarity) == -1).all()
    assert np.isfinite(refused.pose).all()


def test_rays_without_information_are_bridged():
    scan = scan_of(WORLD, POSE)
    ranges = np.asarray(scan.ranges, float)
    ranges[[*range(5), 40, 41, 42, *range(100, 108)]] = np.nan
    holed = Scan.from_bearings(ranges, scan.bearings, range_max=REACH)
    assert error(localised(WORLD, holed).pose, POSE)[0] < PIXEL


def test_the_same_key_gives_the_same_answer():
    scan = scan_of(WORLD, POSE)
    once, again = (localised(WORLD, scan) for _ in range(2))
    for one, other in zip(jax.tree.leaves(once), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)


def test_float64_stays_float64():
    """Traced, not run: a compile of a minute for two words."""
    scan = scan_of(WORLD, POSE)
    with jax.enable_x64(True):
        wide = lambda a: a.astype(float) if a.dtype == jnp.float32 else a
        world, scan = jax.tree.map(wide, (WORLD, scan))
        engine = lambda key: pgl_fmic(key, world, scan, 24, SMALL)
        found = jax.eval_shape(engine, jax.random.key(0))
        floats = [a.dtype for a in jax.tree.leaves(found) if a.dtype != bool]
        assert set(floats) == {jnp.dtype("float64")}


def test_bad_input_is_refused():
    scan = scan_of(WORLD, POSE)
    half = Scan.from_ranges(np.full(181, 2.0), -np.pi / 2, np.pi / 180, 0.0, REACH)
    empty = Scan.from_bearings(np.full(RAYS, np.inf), LIDAR.bearings, range_max=REACH)
    two = jax.tree.map(lambda a: jnp.stack([a, a]), scan)
    for bad, message in [
        ((half,), "partial views"),
        ((empty,), "0 of 180 rays"),
        ((two,), "one scan"),
    ]:
        with pytest.raises(ValueError, match=message):
            localised(WORLD, *bad)
    with pytest.raises(ValueError, match="at least 1 hypothesis"):
        pgl_fmic(jax.random.key(0), WORLD, scan, 0)
    with pytest.raises(ValueError, match="'shift' or 'centroid'"):
        PglFmicConfig(move="sideways")
    with pytest.raises(ValueError, match="32 pixels"):
        PglFmicConfig(size=8)
    with pytest.raises(ValueError, match="at least 1"):
        PglFmicConfig(rounds=0)
    assert isinstance(WORLD, PolygonMap)
