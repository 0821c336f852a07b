"""`localise` on a small office, a room with a twin, and one recorded building."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation import (
    AtlasConfig,
    SearchConfig,
    build_atlas,
    localise,
    localise_batch,
    search,
)
from fsmsm_jax.localisation.judge import explain
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap, buildings, load_map
from tests.worlds import CENTRE, free_poses

RAYS = 360  # all scans of the office, so that `localise` is compiled once
NOISE = 0.01
ORIGIN = (20.0, -30.0, 0.7)
FULL, WIDE, HALF = 2 * np.pi, 1.5 * np.pi, np.pi
# For worlds of a few walls; compiles in a third of the time.
QUICK = SearchConfig(
    headings=60,
    ranked=256,
    descended=32,
    polished=8,
    reported=8,
    search_rays=120,
    descent_rays=60,
)


@jax.jit
def measure(world, lidar, poses, key):
    exact = lambda pose: raycast(world, pose, lidar.bearings, lidar.range_max)
    keys = jax.random.split(key, len(poses))
    return jax.vmap(lidar.measure)(keys, jax.lax.map(exact, poses))


def scans_from(world, poses, fov=FULL, outliers=0.0, rays=RAYS, seed=0):
    lidar = Lidar.create(rays, fov, noise=NOISE, outliers=outliers)
    stacked = measure(world, lidar, poses, jax.random.key(seed))
    return [jax.tree.map(lambda a, i=i: a[i], stacked) for i in range(len(poses))]


def stack(scans):
    return jax.tree.map(lambda *a: jnp.stack(a), *scans)


def error(found, true):
    """Distance [m] and heading difference [rad]."""
    off = np.asarray(found, float) - np.asarray(true, float)
    return np.hypot(off[0], off[1]), abs((off[2] + np.pi) % (2 * np.pi) - np.pi)


def is_right(found, true):
    away, turned = error(found, true)
    return away < 0.3 and turned < np.deg2rad(5)


def plan(seed):
    return np.asarray(buildings.office(seed=seed, width=15, height=10).cells)


def standing(world, count, seed=3):
    """Poses 0.4 m clear of walls."""
    poses = jnp.asarray(free_poses(world, 10 * count, seed), float)
    clear = world.distance_at(poses[:, :2]) > 0.4
    assert clear.sum() >= count
    return poses[clear][:count]


@pytest.fixture(scope="module")
def office():
    return OccupancyGrid.from_cells(plan(1), 0.05, ORIGIN)


@pytest.fixture(scope="module")
def atlas(office):
    return build_atlas(office)


@pytest.fixture(scope="module")
def poses(office):
    return standing(office, 12)


@pytest.mark.parametrize("fov", [FULL, WIDE, HALF])
def test_a_clean_scan_says_where_it_was_taken(office, atlas, poses, fov):
    """360 rays together know better than one of them: under its noise of 1 cm."""
    found = [localise(atlas, s) for s in scans_from(office, poses, fov)]
    right = [is_right(f.pose, p) for f, p in zip(found, poses, strict=True)]
    assert np.mean(right) >= 0.9
    off = [error(f.pose, p) for f, p in zip(found, poses, strict=True)]
    away, turned = np.median(off, axis=0)
    assert away < NOISE
    assert turned < np.deg2rad(0.2)
    sure = np.array([bool(f.confident) for f in found])
    assert not (sure & ~np.array(right)).any()
    assert sure.mean() >= (0.5 if fov == HALF else 0.75)
    for f, ok in zip(found, right, strict=True):
        if ok:
            assert f.explained > 0.95
            assert f.caer_per_ray < 3 * NOISE


@pytest.mark.parametrize("fov", [FULL, WIDE])
def test_people_and_furniture_do_not_lead_astray(office, atlas, poses, fov):
    scans = scans_from(office, poses, fov, outliers=0.3)
    found = [localise(atlas, s) for s in scans]
    right = np.array([is_right(f.pose, p) for f, p in zip(found, poses, strict=True)])
    assert right.mean() >= 0.9
    assert not (np.array([bool(f.confident) for f in found]) & ~right).any()


def test_the_order_of_the_rays_does_not_matter(office, atlas, poses):
    """[−π, π), [0, 2π) and clockwise: the same rays, told differently.

    The search thins them differently, the last polish uses all: equal to a tenth of
    the noise.
    """
    scan = scans_from(office, poses[:1])[0]
    pose = localise(atlas, scan).pose
    assert is_right(pose, poses[0])
    ranges = np.where(scan.echo, scan.ranges, np.inf)
    step, half = FULL / RAYS, RAYS // 2
    for ranges_told, first, increment in (
        (ranges, -np.pi, step),
        (np.roll(ranges, -half), 0.0, step),
        (ranges[::-1], np.pi - step, -step),
        (np.roll(ranges, -half)[::-1], FULL - step, -step),
    ):
        told = Scan.from_ranges(ranges_told, first, increment)
        away, turned = error(localise(atlas, told).pose, pose)
        assert away < NOISE / 10
        assert turned < np.deg2rad(0.05)


def test_a_turned_sensor_stands_in_the_same_place(office, atlas, poses):
    """Bearings 2 rad larger: the heading is 2 rad smaller, and wraps."""
    for i, scan in enumerate(scans_from(office, poses[:4])):
        turned = Scan(scan.ranges, scan.bearings + 2.0, scan.valid, scan.echo,
                      scan.range_max)  # fmt: skip
        here, there = localise(atlas, scan).pose, localise(atlas, turned).pose
        assert is_right(here, poses[i])
        away, turn = error(there.at[2].add(2.0), here)
        assert away < NOISE / 10
        assert turn < np.deg2rad(0.05)


def test_headings_are_wrapped(office, atlas, poses):
    for theta in (-np.pi, np.pi - 1e-3, -np.pi + 1e-3):
        pose = poses[0].at[2].set(theta)
        found = localise(atlas, scans_from(office, pose[None])[0])
        assert is_right(found.pose, pose)
        headings = np.asarray(found.candidates.poses[:, 2])
        assert ((headings >= -np.pi) & (headings < np.pi)).all()


def test_the_answer_hangs_together(office, atlas, poses):
    for scan in scans_from(office, poses[:6], HALF, outliers=0.2):
        found = localise(atlas, scan)
        np.testing.assert_array_equal(found.pose, found.candidates.poses[0])
        assert found.caer_per_ray == found.candidates.caer_per_ray[0]
        scores = np.asarray(found.candidates.scores)
        assert (scores[:-1] >= scores[1:]).all()
        assert np.isfinite(scores[0])
        C = np.asarray(found.covariance, float)
        size = np.sqrt(np.diag(C))
        np.testing.assert_allclose(C / np.outer(size, size),
                                   C.T / np.outer(size, size), atol=1e-4)  # fmt: skip
        assert np.linalg.eigvalsh(C / np.outer(size, size)).min() > 0
        assert 0 <= found.explained <= 1


def test_likelihoods_are_those_that_the_tracker_goes_by(office, atlas, poses):
    """`judge.explain` of the pose, but for the last fit and the walls' thickness.

    It moved a pose by millimetres: 0.05 nats of a σ of 0.1 m. Scores are lower, by
    what ends off walls.
    """
    judge = jax.jit(explain)
    for scan in scans_from(office, poses[:6], HALF):
        best = localise(atlas, scan).candidates
        again = judge(office, scan, best.poses[0]).score
        assert float(best.likelihood[0]) == pytest.approx(float(again), abs=0.05)
        kept = np.isfinite(best.scores)
        assert (best.scores[kept] < best.likelihood[kept]).all()


def assert_distinct(candidates):
    """Two of one place, a tenth of a metre and 5° apart or less, are one candidate."""
    kept = np.asarray(candidates.poses)[np.isfinite(candidates.scores)]
    for i in range(len(kept)):
        for j in range(i):
            away, turned = error(kept[i], kept[j])
            assert away > 0.1 or turned > np.deg2rad(5), (j, i)


def test_candidates_are_distinct_places(office, atlas, poses):
    for scan in scans_from(office, poses, outliers=0.2, seed=5):
        assert_distinct(localise(atlas, scan).candidates)


def test_moving_the_map_moves_the_answer(office, atlas, poses):
    """A lattice lies with its map, headings do not: both end in one optimum."""
    move = jnp.array([-35.0, 12.0, 0.9])  # keeps the node count: no recompilation
    moved = OccupancyGrid.from_cells(
        plan(1), 0.05, geometry.compose(move, office.origin)
    )
    there = build_atlas(moved)
    for scan in scans_from(office, poses[:3], WIDE):
        here = localise(atlas, scan)
        expected = geometry.compose(move, here.pose)
        away, turned = error(localise(there, scan).pose, expected)
        assert away < NOISE / 5
        assert turned < np.deg2rad(0.05)


@pytest.mark.parametrize("fov", [FULL, HALF])
def test_a_scan_of_another_building_is_never_trusted(atlas, fov):
    """Other floors of the same style: 60 scans that this map cannot place."""
    trusted = []
    for seed in (2, 3, 8):
        elsewhere = OccupancyGrid.from_cells(plan(seed), 0.05, ORIGIN)
        scans = scans_from(elsewhere, standing(elsewhere, 20), fov)
        trusted += [bool(localise(atlas, s).confident) for s in scans]
    assert sum(trusted) == 0


def test_one_compilation_serves_all_scans_of_a_sensor(office, atlas, poses):
    first, second = scans_from(office, poses[:2], outliers=0.1)
    localise(atlas, first)
    compiled = search.query._cache_size()
    localise(atlas, second)
    localise(atlas, scans_from(office, poses[:1], HALF)[0])
    assert search.query._cache_size() == compiled


# A rectangular room with a pillar: 0.25 m nodes beside its walls, none on them.
ROOM = np.array([[-3.5, -2.0], [3.5, -2.0], [3.5, 2.0], [-3.5, 2.0]])
PILLAR = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@pytest.fixture(scope="module")
def lopsided():
    """The pillar off the middle: one place for each scan."""
    world = PolygonMap.from_outlines(ROOM + CENTRE, PILLAR + CENTRE + [1.5, 0.5])
    return world, build_atlas(world, AtlasConfig(spacing=0.5))


ROOM_POSES = jnp.asarray(
    np.array([[-2.0, 0.4, 0.3], [-1.3, -1.1, 2.9], [2.7, -1.0, -2.0]]) + [*CENTRE, 0.0],
    float,
)


def test_a_room_and_its_mirror_image_by_half_a_turn():
    """Point-symmetric: two places for each scan, and no way to tell them apart."""
    world = PolygonMap.from_outlines(ROOM + CENTRE, PILLAR + CENTRE)
    twofold = build_atlas(world, AtlasConfig(spacing=0.5))
    for pose, scan in zip(
        ROOM_POSES, scans_from(world, ROOM_POSES, rays=90), strict=True
    ):
        found = localise(twofold, scan, QUICK)
        assert not found.confident
        twin = [*(2 * CENTRE - np.asarray(pose[:2])), float(pose[2]) + np.pi]
        first, second = found.candidates.poses[:2]
        assert is_right(first, pose) or is_right(first, twin)
        assert is_right(second, pose) or is_right(second, twin)
        assert not is_right(first, second)


def test_many_scans_at_once_are_as_one_after_the_other(lopsided):
    """Scans shorter than the search's own rays; float32 sums in another order."""
    world, atlas = lopsided
    scans = scans_from(world, ROOM_POSES, rays=90)
    together = localise_batch(atlas, stack(scans), QUICK)
    assert together.pose.shape == (3, 3)
    assert together.candidates.poses.shape == (3, QUICK.reported, 3)
    for i, scan in enumerate(scans):
        alone = localise(atlas, scan, QUICK)
        assert is_right(alone.pose, ROOM_POSES[i])
        assert alone.confident
        assert together.confident[i]
        assert_distinct(alone.candidates)
        np.testing.assert_allclose(together.pose[i], alone.pose, atol=1e-3)
        np.testing.assert_allclose(together.covariance[i], alone.covariance,
                                   rtol=0.05, atol=1e-8)  # fmt: skip
        np.testing.assert_allclose(together.candidates.scores[i, 0],
                                   alone.candidates.scores[0], atol=1e-3)  # fmt: skip


def bare(function):
    """The function itself, without the type checker that watches over the tests."""
    return inspect.unwrap(function)


def echoes(count):
    """A scan of which only so many rays met something."""
    ranges = np.full(RAYS, np.inf)
    ranges[:: RAYS // count][:count] = 2.0
    return Scan.from_ranges(ranges, -np.pi, FULL / RAYS)


def test_a_scan_that_met_nothing_is_refused(atlas):
    for ranges in (np.full(RAYS, np.inf), np.full(RAYS, 12.0)):
        scan = Scan.from_ranges(ranges, -np.pi, FULL / RAYS, range_max=12.0)
        with pytest.raises(ValueError, match="0 of 360 rays met something"):
            localise(atlas, scan)


def test_echoes_beyond_the_atlas_do_not_count(atlas):
    scan = Scan.from_ranges(np.full(RAYS, atlas.config.reach + 1), 0, FULL / RAYS)
    with pytest.raises(ValueError, match="0 of 360 rays met something within"):
        localise(atlas, scan)


@pytest.mark.parametrize("count", [1, 5])
def test_a_scan_of_few_rays_is_refused(atlas, count):
    with pytest.raises(ValueError, match=f"{count} of 360 rays met .* at least"):
        localise(atlas, echoes(count))
    invalid = np.full(RAYS, np.nan)
    invalid[:count] = 2.0
    with pytest.raises(ValueError, match=f"{count} of 360 rays"):
        localise(atlas, Scan.from_ranges(invalid, -np.pi, FULL / RAYS))


def test_one_bad_scan_spoils_the_batch(atlas, office, poses):
    good = scans_from(office, poses[:1])[0]
    with pytest.raises(ValueError, match="5 of 360 rays"):
        localise_batch(atlas, stack([good, echoes(5)]))


def test_one_scan_is_no_batch_and_a_batch_no_scan(atlas, office, poses):
    scan = scans_from(office, poses[:1])[0]
    with pytest.raises(ValueError, match="localise_batch"):
        localise(atlas, stack([scan, scan]))
    with pytest.raises(ValueError, match=r"\(scans, rays\)"):
        localise_batch(atlas, scan)


@pytest.mark.parametrize("function", [localise, localise_batch])
def test_a_map_is_no_atlas(office, poses, function):
    scan = scans_from(office, poses[:1])[0]
    for thing, name in ((office, "OccupancyGrid"), (None, "NoneType")):
        with pytest.raises(ValueError, match=f"ScanAtlas, got {name}.*build_atlas"):
            bare(function)(thing, scan)


@pytest.mark.parametrize(
    "setting", [{"headings": 51}, {"headings": 0}, {"reported": 1}]
)
def test_settings_that_make_no_search_are_refused(setting):
    """Headings come in pairs; without a runner-up nothing can be trusted."""
    (name,) = setting
    with pytest.raises(ValueError, match=name):
        SearchConfig(**setting)


def test_real_scans_of_a_real_building(data):
    """TurtleBot 4, RPLidar; credit: Olin College, comprobo22."""
    log = np.load(data / "real" / "mac_turtlebot4_take2.npz")
    atlas = build_atlas(load_map(data / "real" / "mac_1st_floor_9_23.yaml"))
    keys = ("angle_min", "angle_increment", "range_min", "range_max")
    for ranges, true in zip(
        log["ranges"][:10], log["pseudo_gt_laser_9_23"], strict=False
    ):
        scan = Scan.from_ranges(ranges, *(float(log[k]) for k in keys))
        found = localise(atlas, scan)
        assert is_right(found.pose, true)
        assert found.explained > 0.7
