"""Localised out of nothing, tracked, kidnapped, lost and found: one log at a time."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.drives import drive, plan, record
from fsmsm_jax.localisation import (
    AtlasConfig,
    FollowConfig,
    Reading,
    SearchConfig,
    build_atlas,
    follow,
    track,
)
from fsmsm_jax.sensing import Lidar
from fsmsm_jax.world import OccupancyGrid
from tests.localisation.simulated import (
    ENDS,
    LIDAR,
    NOISE,
    blind,
    distance,
    office,
    part,
)

SEARCH = dict(headings=60, ranked=256, descended=32, polished=8, reported=8)
CONFIG = FollowConfig(search=SearchConfig(search_rays=120, descent_rays=60, **SEARCH))


def driven(world, start, goal, key=0):
    """Poses, odometry and scans, as NumPy arrays as from a log."""
    ends = np.asarray(world.to_map(jnp.asarray([start, goal], float)), float)
    way = plan(world, *ends)
    found = drive(jax.random.key(key), world, LIDAR, way, 0.5, 1.0, 3.0)
    return jax.tree.map(np.asarray, (found.poses, found.odometry, found.scans))


@pytest.fixture(scope="module", name="office")
def _office():
    return office()


@pytest.fixture(scope="module")
def atlas(office):
    return build_atlas(office, AtlasConfig(spacing=0.5))


@pytest.fixture(scope="module")
def log(office):
    return driven(office, *ENDS)


def spliced(log, *pieces):
    """Parts of a log as one; wheels do not count how the robot got from one to the next."""
    poses, odometry, scans = log
    counted, index = [], np.concatenate([np.arange(*piece) for piece in pieces])
    for piece in pieces:
        here = odometry[np.arange(*piece)]
        last = jnp.asarray(counted[-1][-1] if counted else here[0])
        to = geometry.compose(last, geometry.inverse(jnp.asarray(here[0])))
        counted.append(jax.vmap(geometry.compose, (None, 0))(to, jnp.asarray(here)))
    return poses[index], np.concatenate(counted), part(scans, index)


def readings(scans, odometry):
    return [Reading(part(scans, n), o) for n, o in enumerate(odometry)]


def owned_up(found):
    """Where the pose was said to be in doubt."""
    return np.isin(found.status, ("lost", "doubted"))


def test_from_nothing_to_a_track(atlas, log):
    poses, odometry, scans = part(log, slice(60))
    found = track(atlas, scans, odometry, config=CONFIG)
    first = np.flatnonzero(found.status == "localised")
    assert len(first) == 1
    assert first[0] < 5
    assert (found.status[: first[0]] == "lost").all()
    assert (found.status[first[0] + 1 :] == "tracking").all()
    assert distance(found.pose, poses)[first[0] :].max() < NOISE
    assert found.explained[first[0] :].min() > 0.9
    assert found.caer_per_ray[first[0] :].max() < 0.2
    assert (np.linalg.eigvalsh(found.covariance[first[0] :]) > 0).all()


def test_without_odometry(atlas, log):
    poses, _, scans = part(log, slice(40))
    found = track(atlas, scans, initial=poses[0], config=CONFIG)
    assert (found.status == "tracking").all()
    assert distance(found.pose, poses).max() < NOISE


@pytest.mark.parametrize("off", [[3.0, 0.0, 0.0], [-2.0, 2.0, 1.5]])
def test_a_wrong_initial_pose(atlas, log, off):
    """The user errs by metres: noticed within three scans, and put right."""
    poses, odometry, scans = part(log, slice(20))
    start = geometry.compose(jnp.asarray(poses[0]), jnp.asarray(off))
    found = track(atlas, scans, odometry, start, config=CONFIG)
    right = distance(found.pose, poses) < 0.1
    assert "localised" in found.status
    assert (right | owned_up(found))[3:].all()
    assert right[10:].all()
    assert (found.status[10:] == "tracking").all()


def test_an_initial_pose_that_is_nearly_right(atlas, log):
    poses, odometry, scans = part(log, slice(20))
    start = poses[0] + np.array([0.3, -0.2, 0.15])
    found = track(atlas, scans, odometry, start, config=CONFIG)
    assert (found.status == "tracking").all()
    assert distance(found.pose, poses)[1:].max() < NOISE


@pytest.mark.parametrize("there", [70, 90, 8])
def test_a_kidnap(atlas, log, there):
    """Noticed within three scans, localised right within ten, and tracked again."""
    poses, odometry, scans = spliced(log, (30, 40), (there, there + 20))
    found = track(atlas, scans, odometry, poses[0], config=CONFIG)
    assert (found.status[:10] == "tracking").all()
    away = distance(found.pose, poses)
    assert ((away < 0.1) | owned_up(found))[12:].all()
    assert "localised" in found.status[10:20]
    assert (found.status[20:] == "tracking").all()
    assert away[20:].max() < 2 * NOISE


def test_another_building_is_not_this_one(atlas):
    """Another floor in the same style explains four rays in five here and there, for a
    metre or two; for most of the way, whoever follows has to say so."""
    other = office(2)
    grid = np.array(list(itertools.product(range(20, 300, 10), range(20, 200, 10))))
    free = np.asarray(other.distance_at(other.to_map(jnp.asarray(grid, float)))) > 0.5
    start, goal = grid[free][[0, -1]]
    _, odometry, scans = part(driven(other, start, goal, key=1), slice(60))
    found = track(atlas, scans, odometry, config=CONFIG)
    assert owned_up(found).mean() > 0.8


def test_equal_rooms_part_at_the_door():
    """Two rooms alike down to the pillar, off a corridor that is longer on one side."""
    cells = np.full((220, 320), 100)
    cells[90:120, 10:310] = 0
    for left in (30, 170):
        cells[125:195, left : left + 80] = 0
        cells[120:125, left + 30 : left + 48] = 0
        cells[160:170, left + 8 : left + 16] = 100
    world = OccupancyGrid.from_cells(cells, 0.05, (20.0, -30.0, 0.7))
    poses, odometry, scans = driven(world, [235.0, 178.0], [275.0, 106.0], key=5)
    alike = build_atlas(world, AtlasConfig(spacing=0.5))
    found = track(alike, scans, odometry, config=CONFIG)
    rows = np.asarray(world.to_cells(jnp.asarray(poses[:, :2])))[:, 1]
    inside, outside = rows > 130, np.flatnonzero(rows < 115)
    assert inside.sum() > 5
    assert (found.status[inside] == "lost").all()
    right = distance(found.pose, poses) < 0.1
    assert (right | owned_up(found)).all()
    assert (found.status[outside[4] :] != "lost").all()


def test_nothing_to_see_at_first(atlas, log):
    poses, odometry, scans = part(log, slice(8))
    rows = readings(scans, odometry)
    rows = [Reading(blind(r.scan), r.odometry) for r in rows[:3]] + rows[3:]
    fixes = list(follow(atlas, rows, config=CONFIG))
    for fix in fixes[:3]:
        assert fix.status == "lost"
        assert np.isnan(fix.pose).all()
        assert fix.explained == 0.0
    assert "localised" in [fix.status for fix in fixes[3:]]
    assert distance(fixes[-1].pose, poses[-1]) < 2 * NOISE


def test_nothing_to_see_on_the_way(atlas, log):
    """Dead reckoning says so, and is over with the first scan that sees."""
    poses, odometry, scans = part(log, slice(20))
    rows = readings(scans, odometry)
    rows[8:12] = [Reading(blind(r.scan), r.odometry) for r in rows[8:12]]
    fixes = list(follow(atlas, rows, poses[0], CONFIG))
    says = [fix.status for fix in fixes]
    assert says == ["tracking"] * 8 + ["skipped"] * 4 + ["tracking"] * 8
    assert distance(np.stack([f.pose for f in fixes]), poses)[:8].max() < NOISE
    assert distance(fixes[-1].pose, poses[-1]) < NOISE


def test_odometry_that_starts_at_nought(atlas, log):
    """As most do. The first scan sees, the robot jumps, the second does not see."""
    poses, _, scans = part(log, slice(2))
    rows = np.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.2]])
    rows = [Reading(part(scans, 0), rows[0]), Reading(blind(part(scans, 1)), rows[1])]
    first, second = follow(atlas, rows, poses[0], CONFIG)
    expected = geometry.compose(jnp.asarray(first.pose), jnp.asarray(rows[1].odometry))
    assert second.status == "skipped"
    np.testing.assert_allclose(second.pose, expected, atol=1e-4)


def test_odometry_far_from_its_origin(atlas, log):
    """UTM coordinates: float32 would count in steps of half a metre there."""
    poses, odometry, scans = part(log, slice(8))
    rows = readings(scans, odometry + np.array([5.4e5, 5.2e6, 0.0]))
    rows[4:] = [Reading(blind(r.scan), r.odometry) for r in rows[4:]]
    near = readings(scans, odometry)
    near[4:] = [Reading(blind(r.scan), r.odometry) for r in near[4:]]
    here, there = (list(follow(atlas, each, poses[0], CONFIG)) for each in (near, rows))
    np.testing.assert_allclose(here[-1].pose, there[-1].pose, atol=1e-3)


def test_a_crowd_is_no_kidnap(office, atlas, log):
    """Three rays in ten are cut short all at once; the pose stays, and is believed."""
    poses, odometry, scans = part(log, slice(100))
    crowd = Lidar.create(180, range_max=12.0, noise=NOISE, outliers=0.3)
    crowded = record(jax.random.key(7), office, crowd, jnp.asarray(poses))[1]
    rows = readings(scans, odometry)[:20] + readings(crowded, odometry)[20:50]
    fixes = list(follow(atlas, rows, poses[0], CONFIG))
    assert {fix.status for fix in fixes} <= {"tracking", "doubted"}
    assert fixes[-1].status == "tracking"
    found = np.stack([fix.pose for fix in fixes])
    assert distance(found, poses[:50]).max() < 5 * NOISE


def test_a_log_that_breaks_off_has_been_followed_so_far(atlas, log):
    poses, odometry, scans = part(log, slice(6))

    def breaks():
        yield from readings(scans, odometry)[:4]
        raise OSError("the disk is full")

    fixes, following = [], follow(atlas, breaks(), poses[0], CONFIG)
    with pytest.raises(OSError, match="disk is full"):
        fixes.extend(fix for fix in following if fixes.append(fix))
    assert len(fixes) == 4
    assert distance(fixes[-1].pose, poses[3]) < NOISE


def test_follow_is_lazy(atlas, log):
    """A fix comes before the next scan is asked for: a robot waits for it."""
    poses, odometry, scans = part(log, slice(3))
    asked = []

    def live():
        for n, reading in enumerate(readings(scans, odometry)):
            asked.append(n)
            yield reading

    fixes = follow(atlas, live(), poses[0], CONFIG)
    for n in range(3):
        next(fixes)
        assert asked == list(range(n + 1))


def test_track_stacks_what_follow_says(atlas, log):
    """Rows of float64, of float32 and on the device are one log and one program."""
    poses, odometry, scans = part(log, slice(5))
    fixes = list(follow(atlas, readings(scans, odometry), poses[0], CONFIG))
    for rows in (odometry, odometry.astype(float), jnp.asarray(odometry)):
        found = track(atlas, scans, rows, poses[0].astype(float), config=CONFIG)
        for name in found._fields:
            stacked = np.stack([np.asarray(getattr(fix, name)) for fix in fixes])
            np.testing.assert_array_equal(getattr(found, name), stacked)
    assert found.pose.shape == (5, 3)
    assert found.covariance.shape == (5, 3, 3)
    for fix in fixes:
        assert isinstance(fix.pose, np.ndarray)
        assert isinstance(fix.doubt, float)


def test_an_empty_log(atlas, log):
    _, odometry, scans = part(log, slice(0))
    assert list(follow(atlas, [], config=CONFIG)) == []
    with pytest.raises(ValueError, match="scans"):
        track(atlas, scans, odometry, config=CONFIG)


@pytest.mark.parametrize("initial", [[1.0, 2.0], [1.0, np.nan, 0.0], [[0.0] * 3]])
def test_an_initial_pose_that_is_none(atlas, log, initial):
    _, odometry, scans = part(log, slice(2))
    function = getattr(follow, "__wrapped__", follow)
    with pytest.raises(ValueError, match="three finite numbers"):
        next(iter(function(atlas, readings(scans, odometry), np.array(initial))))


def test_scans_and_rows_that_do_not_fit(atlas, log):
    _, odometry, scans = part(log, slice(4))
    bare = getattr(track, "__wrapped__", track)
    with pytest.raises(ValueError, match=r"expected scans with \(scans, rays\)"):
        bare(atlas, part(scans, 0), odometry)
    with pytest.raises(ValueError, match="odometry has 3 rows for 4 scans"):
        bare(atlas, scans, odometry[:3])
    with pytest.raises(ValueError, match="moments has 2 rows for 4 scans"):
        bare(atlas, scans, odometry, None, np.zeros((2, 180)))
