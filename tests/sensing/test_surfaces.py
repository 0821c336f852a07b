"""Walls behind noisy rays, against the exact ranges and slopes of known rooms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.sensing import Scan, raycast, surfaces
from fsmsm_jax.world import PolygonMap
from tests.alignment.simulated import in_double
from tests.worlds import CENTRE, l_room, square_room

RAYS, MANY = 360, 32  # rays a scan, and scans with noise of their own
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
POSE = jnp.asarray([*(CENTRE + [0.3, -0.2]), 0.4], float)
FAR = 30.0

find = jax.jit(jax.vmap(surfaces))
exact = jax.jit(lambda world: raycast(world, POSE, BEARINGS, FAR))
slope = jax.jit(
    lambda world: jax.jvp(
        lambda b: raycast(world, POSE, b, FAR), (BEARINGS,), (jnp.ones(RAYS),)
    )[1]
)


def scans_of(ranges, valid=None):
    """Panoramas, stacked, of (scans, rays) ranges; what reads 30 m is no echo."""
    ranges = jnp.asarray(ranges, float)
    valid = jnp.ones(ranges.shape, bool) if valid is None else jnp.asarray(valid)
    echo = valid & (ranges < FAR)
    read = jnp.where(echo, ranges, FAR)
    limit = jnp.asarray(FAR)
    return jax.vmap(Scan, (0, None, 0, 0, None), 0)(read, BEARINGS, valid, echo, limit)


def noisy(world, sigma):
    z = np.random.default_rng(0).normal(size=(MANY, RAYS))
    return scans_of(np.asarray(exact(world))[None] + sigma * z)


def one(scans, index=0):
    return jax.tree.map(lambda leaf: leaf[index], scans)


def find_one(scan):
    """By the program for many: another would take longer than it saves."""
    return one(find(jax.tree.map(lambda a: jnp.stack([a] * MANY), scan)))


def pillar_room():
    """A pole of 0.2 m, 1 m before the sensor, in a square room."""
    room = square_room(6.0)
    ahead = np.asarray(POSE[:2]) + [np.cos(0.4), np.sin(0.4)]
    corners = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    pole = PolygonMap.from_outlines(corners + ahead)
    join = lambda a, b: jnp.concatenate([a, b])
    return jax.tree.map(join, room, pole)


@pytest.mark.parametrize("sigma", [0.01, 0.03, 0.05, 0.1])
def test_the_noise_is_read_off_the_scan(sigma):
    """A median of 360 differences is good to 7 %; edges may add some to a small σ."""
    for world in (square_room(4.0), l_room()):
        noise = np.asarray(find(noisy(world, sigma)).noise)
        # Mean of 32: its standard error is 1.3 %; corners bend, which adds 7 % at 1 cm.
        assert 0.96 < noise.mean() / sigma < 1.1
        assert 0.75 < noise.min() / sigma
        assert noise.max() / sigma < 1.3


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_smoothing_leaves_the_noise_that_it_says(sigma):
    room = square_room(4.0)
    found = find(noisy(room, sigma))
    error = np.asarray(found.ranges) - np.asarray(exact(room))[None]
    share = np.asarray(found.share)
    assert (share < 1).mean() > 0.99
    # Rays 20 from a corner: windows of 65 fit there on one side or the other.
    to_corner = np.abs(np.asarray(slope(room)))
    middle = to_corner < 0.5
    z = error[:, middle] / sigma / np.sqrt(share[:, middle])
    # Neighbours share windows: 32 scans × 4 walls are some 128 numbers, ±6 % each σ;
    # that the best window is chosen by its share and not by its luck leaves them at 1.
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.2
    assert np.median(share) < 1 / 15
    assert np.std(error[:, middle]) < 0.3 * sigma  # a window of 17 rays or more


def test_exact_walls_stay_and_slopes_are_the_derivative():
    """Within the 1e-3 of the range up to which a window may reach round a corner."""
    for world, unclear in ((square_room(4.0), 0.06), (l_room(), 0.08)):
        r, dr = np.asarray(exact(world)), np.asarray(slope(world))
        found = find_one(one(scans_of(r[None])))
        np.testing.assert_allclose(found.ranges, r, rtol=0.02)
        wrong = np.abs(np.asarray(found.slope) - dr) > 2e-3 * r + 1e-3
        assert wrong.mean() < unclear  # about the corners


def test_slopes_are_true_in_noise():
    sigma, room = 0.05, square_room(4.0)
    found = find(noisy(room, sigma))
    error = np.asarray(found.slope) - np.asarray(slope(room))[None]
    # Differences of neighbours would be off by √2 σ / γ = 4 m/rad; over 17 rays a line
    # is off by σ / γ / √(17·18·16/12) = 0.14, over 65 by 0.02.
    assert np.median(np.abs(error)) < 0.1


def test_it_does_not_smooth_across_a_pole():
    """Where one surface ends and another begins, no ray lies between the two."""
    world = pillar_room()
    r, sigma = np.asarray(exact(world)), 0.03
    pole = r < 1.3
    assert 8 < pole.sum() < 16  # 0.2 m at 0.9 m
    found = find(noisy(world, sigma))
    error = np.abs(np.asarray(found.ranges) - r[None])
    # Five σ of the raw noise: hardly a ray is worse than it was measured.
    assert np.mean(error > 5 * sigma) < 0.005
    edges = np.flatnonzero(pole != np.roll(pole, -1))
    assert edges.size == 2
    solid = np.asarray(found.solid)
    assert not solid[:, edges].any()  # from the pole to the wall behind it: a veil
    assert solid.mean() > 0.98


def test_walls_and_veils_of_a_hidden_corner():
    """In the L-room one corner hides a part: one veil, where the range jumps."""
    r = np.asarray(exact(l_room()))
    found = find_one(one(scans_of(r[None])))
    jumps = np.abs(np.roll(r, -1) - r) > 0.5
    assert jumps.any()
    assert not np.asarray(found.solid)[jumps].any()


def test_rays_without_an_echo_are_no_wall():
    r = np.asarray(exact(square_room(4.0)))
    ahead = np.abs(np.asarray(BEARINGS)) < 1.0
    behind = np.abs(np.asarray(BEARINGS)) > 2.5
    ranges = np.where(ahead, FAR, r)  # an open door; and a blind sector
    found = find_one(one(scans_of(ranges[None], ~behind[None])))
    neither = ~ahead & ~behind
    known = neither & np.roll(neither, -1)
    np.testing.assert_array_equal(np.asarray(found.solid)[~known], False)
    assert np.asarray(found.solid)[known].all()
    np.testing.assert_array_equal(np.asarray(found.ranges)[~neither], FAR)
    np.testing.assert_array_equal(np.asarray(found.slope)[~neither], 0)
    np.testing.assert_array_equal(np.asarray(found.share)[~neither], 1)
    # Beside them, windows reach to the other side only; nothing leaks in.
    np.testing.assert_allclose(np.asarray(found.ranges)[neither], r[neither], rtol=0.02)


@pytest.mark.parametrize("valid", [True, False])
def test_a_scan_that_sees_nothing(valid):
    nothing = scans_of(np.full((1, RAYS), FAR), np.full((1, RAYS), valid))
    found = find_one(one(nothing))
    assert not np.asarray(found.solid).any()
    for leaf in found:
        assert np.isfinite(leaf).all()
    assert 0 < float(found.noise) < 0.001


def test_quantised_ranges():
    """Whole centimetres: errors of 2.9 mm, and second differences of 0, 5 or 10 mm,
    whose median stands for 6 mm at most."""
    room = square_room(4.0)
    r = np.asarray(exact(room))
    found = find_one(one(scans_of(np.round(r, 2)[None])))
    assert 0.0005 <= float(found.noise) < 0.0062
    error = np.abs(np.asarray(found.ranges) - r)
    assert np.median(error) < 0.0029
    assert np.asarray(found.solid).all()


def test_a_close_and_a_far_scan_stay_finite():
    """Ranges of a millimetre, and 900 m, whose fourth power is 6.6e11."""
    for r in (np.full(RAYS, 0.001), np.full(RAYS, 29.99), np.geomspace(0.01, 29, RAYS)):
        found = find_one(one(scans_of(r[None])))
        for leaf in found:
            assert np.isfinite(leaf).all()
        assert np.asarray(found.ranges).min() > 0


def test_turning_the_scan_turns_the_walls():
    """No ray is special: windows close the circle. Sums of 65 in another order: 1e-4."""
    scan = one(noisy(l_room(), 0.02))
    roll = lambda tree: jax.tree.map(lambda a: jnp.roll(a, 100), tree)
    turned = find_one(eqx.tree_at(lambda s: s.bearings, roll(scan), BEARINGS))
    straight = roll(find_one(scan))
    near = np.abs(np.asarray(turned.ranges) - np.asarray(straight.ranges)) < 1e-4
    assert near.mean() > 0.98  # a window on the verge of being believed may flip
    np.testing.assert_allclose(turned.noise, straight.noise, rtol=1e-5)


def test_one_alone_without_jit_is_as_in_a_batch():
    scans = noisy(l_room(), 0.02)
    batch, alone = find(scans), surfaces(one(scans, 7))
    same = np.abs(np.asarray(batch.ranges[7]) - np.asarray(alone.ranges)) < 1e-4
    assert same.mean() > 0.98  # windows on the verge, as above
    np.testing.assert_allclose(batch.noise[7], alone.noise, rtol=1e-5)
    np.testing.assert_array_equal(batch.solid[7], alone.solid)


def test_float32_is_good_enough():
    scan = one(noisy(square_room(4.0), 0.02))
    single = find_one(scan)
    with jax.enable_x64(True):
        double = jax.jit(surfaces)(in_double(scan))
        assert double.ranges.dtype == double.slope.dtype == np.float64
        # A tenth of the noise, but where rounding takes another window.
        near = np.abs(np.asarray(double.ranges) - np.asarray(single.ranges)) < 0.002
    assert near.mean() > 0.95
    np.testing.assert_allclose(single.noise, double.noise, rtol=1e-4)
