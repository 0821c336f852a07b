"""Panoramas by range: counts, the bound that they are, and whom it leaves standing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import AtlasConfig, build_atlas
from fsmsm_jax.localisation.shells import bins, places_left, scan_shells, shells
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import buildings
from tests.oracles.localisation import share_explained, shell_counts
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE, free_poses, l_room

RAYS = 120
BEARINGS = -np.pi + 2 * np.pi * np.arange(RAYS) / RAYS
WALLS = np.asarray(l_room().start, float), np.asarray(l_room().end, float)
WIDTH = 0.5
KEPT, BEHIND = 0.85, 0.15
"""E of places that are kept in any case, and how far behind the best others may be."""

count_echoes = jax.jit(scan_shells, static_argnums=(1, 2))
places_of = jax.jit(jax.vmap(shells, (0, None)), static_argnums=1)


def scan_of(ranges, echo: bool | np.ndarray = True, valid: bool | np.ndarray = True):
    """Equiangular over the circle, as panoramas are; far beyond what is counted."""
    valid = np.broadcast_to(valid, RAYS)
    echo = np.broadcast_to(echo, RAYS) & valid
    to_jax = jnp.asarray
    return Scan(
        to_jax(np.where(echo, ranges, 50.0), float),
        to_jax(BEARINGS, float),
        to_jax(valid),
        to_jax(echo),
        to_jax(50.0, float),
    )


@pytest.fixture(scope="module")
def building():
    """An office of 24 m by 14 m, and its atlas."""
    world = buildings.office(seed=2, width=24.0, height=14.0)
    return world, build_atlas(world, AtlasConfig(rays=RAYS))


@jax.jit
def left_at(sensor, world, poses, places):
    """Which places are left, of scans from each pose."""

    def one(key, pose):
        exact = raycast(world, pose, sensor.bearings, sensor.range_max)
        seen = scan_shells(sensor.measure(key, exact), RAYS, AtlasConfig().reach)
        return places_left(seen, places)

    return jax.vmap(one)(jax.random.split(jax.random.key(1), len(poses)), poses)


def explained(scan, place):
    """E by the definition, of what the package counted."""
    scan, place = np.asarray(scan, int), np.asarray(place, int)
    return np.minimum(scan, place).sum(axis=-1) / scan.sum()


def jagged(rng):
    """A panorama of flat walls and jumps in depth, from 0.3 to 14 m."""
    edges = np.sort(rng.choice(RAYS, 9, replace=False))
    level = rng.uniform(0.3, 14.0, 10)[np.searchsorted(edges, np.arange(RAYS))]
    return level * (1 + 0.2 * np.sin(np.arange(RAYS) * rng.uniform(0.05, 0.2)))


@pytest.mark.parametrize("reach", [6.0, 6.2, 0.4])
def test_counts_are_those_of_one_ray_at_a_time(reach):
    """Of the scan's own shell, and of the map's with both beside it.

    A reach within a shell counts all of that shell, and what the map has just beyond.
    """
    rng = np.random.default_rng(0)
    number = bins(reach)
    assert number == int(np.ceil(reach / WIDTH))
    # Not at a limit: a panorama's trigonometry rounds.
    ranges = WIDTH * (rng.integers(0, number + 4, RAYS) + rng.uniform(0.01, 0.99, RAYS))
    echo = rng.random(RAYS) < 0.8
    wanted = shell_counts(ranges, echo, WIDTH, number)
    assert 0 < wanted.sum() < echo.sum()
    seen = count_echoes(scan_of(ranges, echo), RAYS, reach)
    np.testing.assert_array_equal(seen, wanted)

    ranges[:5] = 0.0, 0.5, reach, 5.5, 6.0  # limits that floats hold exactly
    ranges = ranges.astype(np.float32)
    one = shell_counts(ranges, np.ones(RAYS, bool), WIDTH, number + 1)
    three = [one[max(b - 1, 0) : b + 2].sum() for b in range(number)]
    found = shells(jnp.asarray(ranges, float), reach)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, three)


def test_rays_that_say_nothing_are_not_counted():
    """Gaps of 2 and more are not filled by the panorama, and have no echo."""
    valid = np.arange(RAYS) // 10 % 2 == 0
    seen = count_echoes(scan_of(np.full(RAYS, 2.2), valid=valid), RAYS, 6.0)
    assert int(seen[4]) == int(seen.sum()) == valid.sum()


def test_a_byte_is_enough_for_all_rays_in_one_shell():
    assert int(shells(jnp.full(255, 3.1), 6.0).max()) == 255


@pytest.mark.parametrize(("reach", "half"), [(15.0, False), (8.2, True)])
def test_no_heading_explains_more_than_the_bound(reach, half):
    """Scans of other places, of the same one, and of one that is a little aside.

    Of the same one, turned, the bound is reached: everything is explained.
    """
    rng = np.random.default_rng(1)
    ahead = np.abs(np.arange(RAYS) - RAYS / 2) < (RAYS / 4 if half else RAYS)
    closest = 0.0
    for kind in ("other", "same", "aside") * 8:
        place = jagged(rng)
        turn = rng.integers(RAYS)
        scan = jagged(rng) if kind == "other" else np.roll(place, turn)
        if kind == "aside":
            scan = np.maximum(scan + rng.normal(0, 0.4, RAYS), 0.05)
        echo = ahead & (rng.random(RAYS) < 0.9)
        # In the same float32, or a range at a limit is in two shells at once.
        scan, place = (np.asarray(a, np.float32) for a in (scan, place))
        seen = count_echoes(scan_of(scan, echo, ahead), RAYS, reach)
        bound = explained(seen, shells(jnp.asarray(place), reach))
        counted = echo & (scan < bins(reach) * WIDTH)
        assert int(seen.sum()) == counted.sum() > 0
        best = max(share_explained(scan, counted, place, k, WIDTH) for k in range(RAYS))
        assert best <= bound + 1e-9
        if kind == "same":
            assert best == bound == 1
        if kind == "aside":
            closest = max(closest, best / bound)
    assert closest > 0.9  # the bound is no idle one


def test_turning_the_scan_changes_nothing():
    """By whole rays; in between, ranges are interpolated and few change their shell."""
    exact = cast_walls(*WALLS, CENTRE, 0.3 + BEARINGS, 50.0)
    scan = scan_of(exact + np.random.default_rng(2).normal(0, 0.01, RAYS))
    step = 2 * np.pi / RAYS
    turned = lambda by: Scan(
        scan.ranges, scan.bearings + by, scan.valid, scan.echo, scan.range_max
    )
    count = count_echoes(scan, RAYS, 6.0)
    assert int(count.sum()) > 0.9 * RAYS
    for by in (step, -17 * step, 60 * step):
        np.testing.assert_array_equal(count_echoes(turned(by), RAYS, 6.0), count)
    between = count_echoes(turned(10.5 * step), RAYS, 6.0)
    assert int(jnp.abs(between - count).sum()) <= 0.15 * RAYS


def test_a_sensor_of_other_rays_counts_as_many():
    """Half a circle in half degrees asks for half of the map's rays."""
    here, ahead = CENTRE + [0.7, 0.4], np.deg2rad(np.arange(-180, 181) / 2)
    exact = cast_walls(*WALLS, here, 0.3 + ahead, 50.0)
    seen = count_echoes(Scan.from_bearings(exact, ahead, 0.1, 50.0), RAYS, 15.0)
    assert abs(int(seen.sum()) - RAYS / 2) <= 1
    around = cast_walls(*WALLS, here, 0.3 + BEARINGS, 50.0)
    assert explained(seen, shells(jnp.asarray(around, float), 15.0)) == 1


def test_places_are_kept_by_the_rule():
    """And those of no ray at all go, unless the scan has none either."""
    rng = np.random.default_rng(3)
    place = np.stack([jagged(rng) for _ in range(200)])
    kept = places_of(jnp.asarray(place, float), 15.0).at[7].set(0)
    for seed, spoilt in enumerate((0.0, 0.2, 0.5, 0.9)):
        scan = np.roll(place[seed], 31)
        off = rng.random(RAYS) < spoilt
        scan = np.where(off, scan * rng.uniform(0.02, 0.6, RAYS), scan)
        seen = count_echoes(scan_of(scan), RAYS, 15.0)
        share = explained(seen, kept)
        wanted = share >= min(KEPT, share.max() - BEHIND) - 1e-6
        left = np.asarray(places_left(seen, kept))
        assert left[share.argmax()]
        assert not left[7]
        assert not left.all()
        np.testing.assert_array_equal(left, wanted)
    nothing = count_echoes(scan_of(0.0, echo=False), RAYS, 15.0)
    assert int(nothing.sum()) == 0
    assert places_left(nothing, kept).all()


@pytest.mark.parametrize("fov", [2 * np.pi, np.pi])
def test_the_right_place_stays_in_a_building_full_of_people(building, fov):
    """Thirty per cent of the rays end somewhere on the way, at 50 places; all stay.

    The place stays if a node within a spacing does: the nearest may stand behind a
    wall. Poses are 0.4 m clear of walls: nearer ones look unlike any node around, and
    some per cent are lost. And half the building goes, or the shells would do nothing.
    """
    world, atlas = building
    tile, row, column = np.nonzero(np.asarray(atlas.tiles.allowed))
    row, column = np.asarray(atlas.tiles.corner)[tile].T + [row, column]
    nodes = np.asarray(atlas.lattice.to_map(jnp.asarray(row), jnp.asarray(column)))
    told = np.asarray(atlas.tiles.shells)[np.asarray(atlas.tiles.allowed)]
    poses = free_poses(world, 200, seed=5)
    clear = world.distance_at(jnp.asarray(poses[:, :2], float)) > 0.4
    poses = poses[np.asarray(clear)][:50]
    assert len(poses) == 50

    sensor = Lidar.create(180, fov, noise=0.01, outliers=0.3, range_max=30.0)
    poses = jnp.asarray(poses, float)
    left = np.asarray(left_at(sensor, world, poses, jnp.asarray(told)))
    gap = np.hypot(*np.moveaxis(nodes[None] - np.asarray(poses)[:, None, :2], -1, 0))
    right = gap < atlas.config.spacing
    assert right.any(axis=1).all()
    assert (left & right).any(axis=1).all()
    assert left.mean() < 0.75


def test_jit_and_vmap_change_nothing():
    rng = np.random.default_rng(4)
    place = jnp.asarray(np.stack([jagged(rng) for _ in range(5)]), float)
    many = places_of(place, 15.0)
    for one, ranges in zip(many, place, strict=True):
        np.testing.assert_array_equal(one, shells(ranges, 15.0))
    scans = [scan_of(np.asarray(ranges), rng.random(RAYS) < 0.8) for ranges in place]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scans)
    counted = jax.jit(jax.vmap(lambda scan: scan_shells(scan, RAYS, 15.0)))(stacked)
    left = jax.vmap(places_left, (0, None))(counted, many)
    for i, scan in enumerate(scans):
        alone = count_echoes(scan, RAYS, 15.0)
        np.testing.assert_array_equal(counted[i], alone)
        np.testing.assert_array_equal(left[i], places_left(alone, many))
