"""Drives: the way is free and short, the robot follows it, the record is right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import Lidar, OccupancyGrid, geometry, raycast
from fsmsm_jax.evaluation.drives import drive, plan, record
from fsmsm_jax.localisation.motion import OdometryModel
from tests.worlds import CENTRE, l_room

EXACT = OdometryModel(0.0, 0.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
LIDAR = Lidar.create(40, 4.5, 12.0, noise=0.02)


def two_rooms(turn=0.6):
    """A wall with a door at its upper end, on a turned and shifted grid."""
    cells = np.zeros((100, 160), int)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    cells[:75, 78:82] = 100
    return OccupancyGrid.from_cells(cells, 0.05, (-21.0, 33.0, turn))


def in_map(grid, column, row):
    return np.asarray(grid.to_map(jnp.asarray([column, row], float)), float)


def test_the_way_goes_through_the_door():
    grid = two_rooms()
    start, goal = in_map(grid, 30, 20), in_map(grid, 130, 20)
    way = plan(grid, start, goal, 0.5)
    np.testing.assert_allclose(way[[0, -1]], [start, goal])
    fine = np.concatenate(
        [
            a + (b - a) * np.linspace(0, 1, 50)[:, None]
            for a, b in zip(way, way[1:], strict=False)
        ]
    )
    assert np.asarray(grid.distance_at(jnp.asarray(fine, float))).min() > 0.2
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    corner = [in_map(grid, c, 75 + 5) for c in (77, 83)]
    shortest = sum(
        np.linalg.norm(b - a)
        for a, b in zip([start, *corner], [*corner, goal], strict=True)
    )
    assert shortest < length < 1.25 * shortest
    assert len(way) < 12


def test_in_the_open_the_way_is_straight():
    grid = two_rooms()
    start, goal = in_map(grid, 25, 25), in_map(grid, 50, 70)
    assert len(plan(grid, start, goal)) == 2


def test_a_turned_world_turns_the_way():
    lengths = []
    for turn in (0.0, 0.6, 2.5):
        grid = two_rooms(turn)
        way = plan(grid, in_map(grid, 30, 20), in_map(grid, 130, 20))
        lengths.append(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-3)


def test_polygons_are_driven_in_as_well():
    room = l_room()
    start, goal = CENTRE + [3.4, 0.0], CENTRE + [-0.5, 4.4]
    way = plan(room, start, goal, 0.6)
    assert len(way) > 2
    found = drive(jax.random.key(0), room, LIDAR, way)
    assert bool(room.contains(found.poses[:, :2]).all())
    assert float(room.distance_at(found.poses[:, :2]).min()) > 0.25


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        ((80, 20), (130, 20), "the start .* is not in open space"),
        ((30, 20), (500, 20), "the goal .* is not in open space"),
        ((30, 20), (157, 20), "the goal .* is not in open space"),
    ],
)
def test_ends_in_walls(start, goal, message):
    grid = two_rooms()
    with pytest.raises(ValueError, match=message):
        plan(grid, in_map(grid, *start), in_map(grid, *goal))


def test_no_way():
    grid = two_rooms()
    cells = np.array(grid.cells)
    cells[:, 78:82] = 100
    shut = OccupancyGrid.from_cells(cells, 0.05, np.asarray(grid.origin))
    with pytest.raises(ValueError, match="no way leads"):
        plan(shut, in_map(shut, 30, 20), in_map(shut, 130, 20))
    with pytest.raises(
        ValueError, match="clearance must be positive|clearance must be"
    ):
        plan(grid, in_map(grid, 30, 20), in_map(grid, 130, 20), 0.0)


@pytest.fixture(scope="module")
def grid():
    return two_rooms()


@pytest.fixture(scope="module")
def way(grid):
    return plan(grid, in_map(grid, 30, 20), in_map(grid, 130, 20))


@pytest.mark.parametrize(("speed", "heading"), [(0.4, None), (1.5, -2.0)])
def test_the_robot_follows_the_way(grid, way, speed, heading):
    found = drive(
        jax.random.key(0), grid, LIDAR, way, speed, 1.2, 4.0, start_heading=heading
    )
    poses = np.asarray(found.poses, float)
    if heading is None:
        ahead = way[1] - way[0]
        heading = np.arctan2(ahead[1], ahead[0])
    np.testing.assert_allclose(poses[0], [*way[0], heading], atol=1e-4)
    assert np.linalg.norm(poses[-1, :2] - way[-1]) < 0.06
    assert float(grid.distance_at(found.poses[:, :2]).min()) > 0.15
    np.testing.assert_allclose(np.diff(found.stamps), 0.25)
    step = np.diff(poses, axis=0)
    step[:, 2] = np.angle(np.exp(1j * step[:, 2]))
    assert np.linalg.norm(step[:, :2], axis=1).max() < speed / 4 * 1.01
    assert np.abs(step[:, 2]).max() < 1.2 / 4 * 1.01
    # Wheels do not slide sideways: the way of a step lies along the mean heading.
    middle = poses[:-1, 2] + step[:, 2] / 2
    sideways = -np.sin(middle) * step[:, 0] + np.cos(middle) * step[:, 1]
    assert np.abs(sideways).max() < 0.15 * speed / 4


def test_the_record(grid, way):
    """Exact odometry is the true motion in another frame; scans are those of the poses."""
    mount = (0.2, -0.1, 0.5)
    found = drive(
        *(jax.random.key(0), grid, LIDAR, way, 0.5, 1.0, 2.0, EXACT),
        pose_base_lidar=mount,
    )
    assert found.scans.ranges.shape == (len(found.poses), 40)
    assert found.scans.bearings.shape == found.scans.ranges.shape
    assert found.scans.range_max.shape == found.stamps.shape
    assert np.abs(np.asarray(found.odometry[0] - found.poses[0])[:2]).min() > 1
    motion = jax.vmap(geometry.between)
    np.testing.assert_allclose(
        motion(found.odometry[:-1], found.odometry[1:]),
        motion(found.poses[:-1], found.poses[1:]),
        atol=2e-4,
    )
    for n in (0, len(found.poses) // 2):
        exact = raycast(grid, found.poses[n], LIDAR.bearings, LIDAR.range_max)
        off = np.asarray(found.scans.ranges[n] - exact)[np.asarray(found.scans.echo[n])]
        assert np.abs(off).max() < 0.1
        assert 0.005 < off.std() < 0.04
    base = geometry.compose(found.poses[0], geometry.inverse(jnp.asarray(mount)))
    np.testing.assert_allclose(base[:2], way[0], atol=1e-4)


def test_a_key_is_a_drive(grid, way):
    runs = [drive(jax.random.key(k), grid, LIDAR, way, rate_hz=2.0) for k in (1, 1, 2)]
    for same, again in zip(
        jax.tree.leaves(runs[0]), jax.tree.leaves(runs[1]), strict=True
    ):
        assert np.array_equal(same, again)
    assert np.array_equal(runs[0].poses, runs[2].poses)
    assert not np.array_equal(runs[0].scans.ranges, runs[2].scans.ranges)
    assert not np.allclose(runs[0].odometry[1:], runs[2].odometry[1:])


def test_many_records_of_one_drive(grid, way):
    found = drive(jax.random.key(3), grid, LIDAR, way, rate_hz=1.0)
    keys = jax.random.split(jax.random.key(4), 3)
    odometry, scans = jax.vmap(record, (0, None, None, None))(
        keys, grid, LIDAR, found.poses
    )
    for n, key in enumerate(keys):
        alone, seen = record(key, grid, LIDAR, found.poses)
        np.testing.assert_allclose(odometry[n], alone, atol=1e-4)
        np.testing.assert_allclose(scans.ranges[n], seen.ranges, atol=1e-4)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"way": np.zeros((1, 2))}, "points ≥ 2"),
        ({"way": np.zeros((3, 2))}, "no length"),
        ({"way": np.array([[0, 0], [np.nan, 1]])}, "not finite"),
        ({"speed": 0.0}, "must be positive"),
    ],
)
def test_bad_input(grid, way, wrong, message):
    with pytest.raises(ValueError, match=message):
        drive(jax.random.key(0), grid, LIDAR, **({"way": way} | wrong))
