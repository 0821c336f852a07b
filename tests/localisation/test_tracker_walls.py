"""The tracker between a few straight walls: exact worlds, corridors, quick turns.

All worlds have eight walls and all drives `TIMES` scans: `run` is compiled once.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.drives import record
from fsmsm_jax.localisation import tracker
from fsmsm_jax.sensing import raycast
from fsmsm_jax.sensing.sweep import fraction
from fsmsm_jax.world import PolygonMap
from tests.localisation.simulated import LIDAR, NOISE, error, nees, part, start
from tests.worlds import CENTRE

TIMES = 100
# A corner of an L, with a niche, so that it has as many walls as the corridor.
ROOM = [[-3, -1], [4, -1], [4, 1.5], [1, 1.5], [1, 5], [0, 5], [0, 4], [-3, 4]]


@pytest.fixture(scope="module")
def room():
    return PolygonMap.from_outlines(np.array(ROOM) + CENTRE)


@pytest.fixture(scope="module")
def laps(room):
    """Quick turns about a point of the room: 0.5 rad a scan."""
    n = np.arange(TIMES)
    around = np.stack([0.8 * np.cos(n / 12), 0.6 * np.sin(n / 12)], axis=1)
    heading = np.mod(0.5 * n + 0.9 + np.pi, 2 * np.pi) - np.pi
    poses = np.column_stack([CENTRE + [-1.0, 0.5] + around, heading])
    poses = jnp.asarray(poses, float)
    return poses, *record(jax.random.key(1), room, LIDAR, poses)


def test_a_moved_world_moves_the_track(room, laps):
    """Float32 at 30 m knows a wall to 2e-6 m; a tenth of the noise is allowed."""
    poses, odometry, scans = laps
    move = jnp.asarray([-31.0, 22.0, 2.3])
    to_there = jax.vmap(geometry.compose, (None, 0))
    walls = geometry.transform_points(move, jnp.asarray(np.array(ROOM) + CENTRE))
    there = PolygonMap.from_outlines(np.asarray(walls))
    _, info = tracker.run(room, start(room, poses, odometry), scans, odometry)
    assert error(info.pose, poses)[0].max() < NOISE
    assert 1.5 < np.mean(nees(info, poses)) < 9
    moved = to_there(move, poses)
    _, found = tracker.run(there, start(there, moved, odometry), scans, odometry)
    away, turned = error(found.pose, to_there(move, info.pose))
    assert away.max() < NOISE / 10
    assert turned.max() < 1e-3


@pytest.mark.parametrize("heading", [0.0, 0.8])
def test_a_corridor_says_nothing_of_the_way_along_it(heading):
    """Two walls, ends out of sight: odometry speaks along them, the scan across."""
    strip = lambda y: [[-40, y], [40, y], [40, y + 0.2], [-40, y + 0.2]]
    local = np.array([strip(-1.2), strip(1.0)], float)
    frame = jnp.asarray([*CENTRE, heading])
    walls = geometry.transform_points(frame, jnp.asarray(local, float))
    corridor = PolygonMap.from_outlines(*np.asarray(walls, float))
    n = np.arange(TIMES)
    way = np.column_stack([0.1 * n - 5, 0.2 * np.sin(n / 9), 0.2 * np.cos(n / 9)])
    poses = jax.vmap(geometry.compose, (None, 0))(frame, jnp.asarray(way, float))
    odometry, scans = record(jax.random.key(2), corridor, LIDAR, poses)
    _, info = tracker.run(corridor, start(corridor, poses, odometry), scans, odometry)

    assert not info.lost.any()
    assert info.corrected.all()
    in_corridor = jax.vmap(geometry.between, (None, 0))
    off = np.asarray(in_corridor(frame, info.pose) - in_corridor(frame, poses), float)
    c, s = np.cos(heading), np.sin(heading)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned = axes.T @ np.asarray(info.covariance, float) @ axes
    assert np.linalg.eigvalsh(turned).min() > 0
    sigma = np.sqrt(np.diagonal(turned, axis1=1, axis2=2))
    assert (np.diff(sigma[:, 0]) > 0).all()
    assert sigma[-1, 0] > 2 * sigma[10, 0]
    # 180 rays of 1 cm, half of which slant, leave 1 mm open; one scan in fifty looks
    # as if the walls were bent and is trusted less.
    assert np.quantile(sigma[5:, 1], 0.9) < 1e-3
    assert np.rad2deg(sigma[5:, 2].max()) < 0.1
    assert np.abs(off[:, 1]).max() < 4e-3
    assert (np.abs(off) < 4 * sigma).all()
    # The way along is odometry's: a percent of 10 m, from headings that it got wrong.
    counted = jax.vmap(geometry.between)(odometry[:-1], odometry[1:])
    ahead = np.sum(np.asarray(counted[:, 0]) * np.cos(way[:-1, 2]))
    gone = in_corridor(frame, info.pose)[:, 0]
    np.testing.assert_allclose(gone[-1] - gone[0], ahead, atol=0.1)


def test_motion_compensation(room, laps):
    """Rays cast one after the other: put right, the track is as good as if not swept."""
    poses = laps[0]
    motions = jax.vmap(geometry.between)(poses[:-1], poses[1:])
    odometry = poses  # an error of it would smear the rays again
    motions = jnp.concatenate([jnp.zeros((1, 3)), motions])
    when = jnp.broadcast_to(jnp.linspace(-1.0, 0.0, 180), (TIMES, 180)).at[0].set(0.0)

    def cast(pose, motion, moments):
        there = lambda m: geometry.compose(pose, fraction(motion, m))
        ray = lambda m, b: raycast(room, there(m), b[None], LIDAR.range_max)[0]
        return jax.vmap(ray)(moments, LIDAR.bearings)

    exact = jax.jit(jax.vmap(cast))(poses, motions, when)
    keys = jax.random.split(jax.random.key(3), TIMES)
    scans = jax.vmap(LIDAR.measure)(keys, exact)
    off = {}
    for name, moments in (("left", jnp.zeros_like(when)), ("put right", when)):
        state = start(room, poses, odometry)
        _, info = tracker.run(room, state, scans, odometry, moments)
        off[name] = error(info.pose, poses)[0]
    assert off["put right"].max() < NOISE
    assert np.median(off["put right"]) < np.median(off["left"]) / 5


@pytest.mark.slow
def test_compiled_and_not(room, laps):
    poses, odometry, scans = laps
    state, scan = start(room, poses, odometry), part(scans, 0)
    _, jitted = tracker.step(room, state, scan, odometry[0])
    _, eager = inspect.unwrap(tracker.step)(room, state, scan, odometry[0])
    np.testing.assert_allclose(eager.pose, jitted.pose, atol=NOISE / 10)
    np.testing.assert_allclose(eager.score, jitted.score, atol=1e-3)
