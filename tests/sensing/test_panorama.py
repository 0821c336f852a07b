import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from fsmsm_jax.sensing import Lidar, Scan, panorama, raycast
from tests.worlds import CENTRE, l_room, square_room

RAYS = 360
POSE = jnp.array([*(CENTRE + [0.6, -0.4]), 0.7])
resample = jax.jit(panorama, static_argnums=1)
cast = jax.jit(raycast)


def scan_of(world, bearings, order=None):
    """An exact scan of a world, its rays in the given order."""
    bearings = np.asarray(bearings)[order if order is not None else slice(None)]
    ranges = cast(world, POSE, jnp.asarray(bearings, jnp.float32))
    return Scan.from_bearings(ranges, bearings, 0.0, 30.0)


TURN = 2 * np.pi
LAYOUTS = {
    "as wanted": np.linspace(-np.pi, np.pi, 360, endpoint=False),
    "from zero": np.arange(360) * TURN / 360,
    "clockwise": np.pi - np.arange(360) * TURN / 360,
    "both ends": np.linspace(-np.pi, np.pi, 361),
    "beyond a turn": 5 + np.arange(400) * TURN / 360,
    "odd start": 0.1234 + np.arange(360) * TURN / 360,
    "denser": np.arange(1440) * TURN / 1440,
    "sparser": 0.01 + np.arange(120) * TURN / 120,
    "jittered": np.arange(360) * TURN / 360
    + np.random.default_rng(0).uniform(-0.004, 0.004, 360),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_shows_the_same_room(layout):
    bearings = LAYOUTS[layout]
    full = resample(scan_of(square_room(), bearings), RAYS)
    np.testing.assert_allclose(full.bearings, -np.pi + TURN * np.arange(RAYS) / RAYS)
    assert full.valid.all()
    assert full.echo.all()
    exact = cast(square_room(), POSE, full.bearings)
    error = np.abs(full.ranges - exact)
    # Chords are exact on flat walls, up to rounding; a corner is cut within one
    # source spacing, by less than the range times that spacing.
    spacing = max(TURN / len(bearings), TURN / RAYS)
    assert np.quantile(error, 0.95 if layout == "sparser" else 0.98) < 1e-4
    assert error.max() < 4 * spacing


def test_a_scan_already_in_form_comes_back():
    lidar = Lidar.create(rays=RAYS, noise=0.05, dropout=0.2, range_max=3.0)
    scan = lidar.measure(jax.random.key(1), cast(l_room(), POSE, lidar.bearings, 3.0))
    full = resample(scan, RAYS)
    np.testing.assert_array_equal(full.valid, scan.valid)
    np.testing.assert_array_equal(full.echo, scan.echo)
    np.testing.assert_allclose(full.ranges, scan.ranges, rtol=1e-4)
    assert 0.1 < np.mean(~scan.valid) < 0.3
    assert (scan.valid & ~scan.echo).any()


@given(st.permutations(range(97)), st.integers(0, 96))
def test_the_order_of_rays_does_not_matter(order, lost):
    bearings = 0.05 + np.arange(97) * TURN / 97
    scan = scan_of(l_room(), bearings)
    scan = Scan.from_bearings(
        np.where(np.arange(97) == lost, np.nan, scan.ranges), bearings
    )
    shuffled = jax.tree.map(lambda a: a[np.array(order)] if a.ndim else a, scan)
    for a, b in zip(
        jax.tree.leaves(resample(scan, 90)),
        jax.tree.leaves(resample(shuffled, 90)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_outside_the_field_of_view_nothing_is_said(degrees):
    lidar = Lidar.create(rays=2 * degrees + 1, field_of_view=np.deg2rad(degrees))
    full = resample(scan_of(square_room(), lidar.bearings), RAYS)
    seen = np.abs(np.rad2deg(np.asarray(full.bearings))) <= degrees / 2 + 0.76
    np.testing.assert_array_equal(full.valid, seen)
    np.testing.assert_array_equal(full.ranges[~seen], 30.0)
    exact = cast(square_room(), POSE, full.bearings)
    inside = np.abs(np.rad2deg(np.asarray(full.bearings))) <= degrees / 2
    assert np.abs(full.ranges - exact)[inside].max() < 0.05


def test_a_hole_stays_a_hole_and_is_not_bridged():
    bearings = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    ranges = np.full(RAYS, 2.0)
    ranges[100:110] = np.nan
    full = resample(Scan.from_bearings(ranges, bearings), RAYS)
    np.testing.assert_array_equal(np.flatnonzero(~full.valid), np.arange(100, 110))
    finer = resample(Scan.from_bearings(ranges, bearings), 2 * RAYS)
    # Rays within ¾ of a source spacing of the hole's rims still know something.
    np.testing.assert_array_equal(np.flatnonzero(~finer.valid), np.arange(200, 219))


def test_depth_jumps_are_not_filled_with_phantoms():
    bearings = 0.004 + np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    ranges = np.where(np.arange(RAYS) // 30 % 2, 2.0, 8.0)
    full = resample(Scan.from_bearings(ranges, bearings), RAYS)
    assert set(np.round(np.asarray(full.ranges), 2)) == {2.0, 8.0}
    assert full.valid.all()


def test_no_echo_is_information_and_stays_apart_from_invalid():
    bearings = 0.004 + np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    ranges = np.full(RAYS, 3.0)
    ranges[50:80] = np.inf
    ranges[200:230] = 0.0
    full = resample(Scan.from_bearings(ranges, bearings, 0.1, 10.0), RAYS)
    free = np.asarray(full.valid & ~full.echo)
    # Wanted rays lie 0.004 rad, about a quarter of a spacing, before the source's.
    np.testing.assert_array_equal(np.flatnonzero(free), np.arange(50, 80))
    np.testing.assert_array_equal(full.ranges[50:80], 10.0)
    assert full.valid[49]
    assert full.echo[49]
    # At the hole's far rim the previous wanted ray is ¾ + of a spacing away: lost;
    # at the near rim the last good ray still speaks only for its own.
    np.testing.assert_array_equal(np.flatnonzero(~full.valid), np.arange(200, 230))
    everywhere = Scan.from_bearings(np.full(RAYS, np.inf), bearings, 0.1, 10.0)
    nothing = resample(everywhere, RAYS)
    assert nothing.valid.all()
    assert not nothing.echo.any()


@pytest.mark.parametrize("rays", [1, 2, 3])
def test_very_few_rays_do_not_fill_the_circle(rays):
    scan = Scan.from_bearings(np.full(rays, 2.0), np.arange(rays) * 0.1)
    full = resample(scan, RAYS)
    assert full.valid.any()
    assert np.mean(full.valid) <= 0.25 + 0.2 / TURN + 1 / RAYS
    assert np.isfinite(full.ranges).all()


def test_degenerate_scans_give_no_nan_and_no_false_validity():
    bearings = jnp.zeros(8)
    all_lost = Scan(
        ranges=jnp.full(8, 30.0),
        bearings=bearings,
        valid=jnp.zeros(8, bool),
        echo=jnp.zeros(8, bool),
        range_max=jnp.array(30.0),
    )
    full = resample(all_lost, RAYS)
    assert not full.valid.any()
    np.testing.assert_array_equal(full.ranges, 30.0)
    at_zero = Scan(
        ranges=jnp.zeros(8),
        bearings=bearings,
        valid=jnp.ones(8, bool),
        echo=jnp.ones(8, bool),
        range_max=jnp.array(30.0),
    )
    full = resample(at_zero, RAYS)
    assert np.isfinite(full.ranges).all()
    assert np.mean(full.valid) < 0.3


def test_vmap_is_a_loop_and_float64_is_near():
    lidar = Lidar.create(rays=271, field_of_view=np.deg2rad(270), dropout=0.1)
    exact = cast(l_room(), POSE, lidar.bearings)
    keys = jax.random.split(jax.random.key(0), 4)
    scans = jax.vmap(lidar.measure, (0, None))(keys, exact)
    batch = jax.jit(jax.vmap(lambda s: panorama(s, RAYS)))(scans)
    for i in range(4):
        one = resample(jax.tree.map(lambda a, i=i: a[i], scans), RAYS)
        np.testing.assert_array_equal(batch.valid[i], one.valid)
        np.testing.assert_allclose(batch.ranges[i], one.ranges, rtol=1e-5)
    eager = panorama(jax.tree.map(lambda a: a[0], scans), RAYS)
    np.testing.assert_allclose(batch.ranges[0], eager.ranges, rtol=1e-5)
    first = jax.tree.map(lambda a: np.asarray(a[0]), scans)
    with jax.enable_x64(True):
        wide = jax.tree.map(
            lambda a: jnp.asarray(a, float if a.dtype == np.float32 else bool), first
        )
        precise = resample(wide, RAYS)
        assert precise.ranges.dtype == jnp.float64
        assert np.mean(np.asarray(precise.valid) == np.asarray(batch.valid[0])) > 0.99
        error = np.abs(np.asarray(precise.ranges) - np.asarray(batch.ranges[0]))
    assert np.median(error) < 1e-5


def test_too_few_rays_are_refused():
    scan = Scan.from_ranges(np.ones(8), 0.0, 0.5)
    with pytest.raises(ValueError, match="at least 3 rays, got 2"):
        panorama(scan, 2)


def test_real_dirty_scans_keep_their_echoes(data):
    """Ydlidar logs, nine readings of ten zero: what is kept was measured."""
    paths = sorted((data / "logs").glob("ydlidar_x4_*.npz"))
    assert paths
    for path in paths:
        log = np.load(path)
        for turn in (3, 100, 200):
            rays = log["n"][turn]
            row = log["ranges"][turn, :rays]
            scan = Scan.from_ranges(row, 0.0, -TURN / rays, 0.1, 12.0)
            assert np.mean(~scan.valid) > 0.5
            full = resample(scan, RAYS)
            kept = np.asarray(full.ranges)[np.asarray(full.echo)]
            assert row[row > 0].min() * 0.999 <= kept.min()
            assert kept.max() <= row.max() * 1.001
            # A wanted ray reaches ¾ of its spacing to both sides, no further.
            assert full.valid.sum() <= 1.5 * scan.valid.sum() + 1
