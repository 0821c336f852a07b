"""The lidar's place in a simulated robot, and in a real one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.calibration import MountingConfig, mounting
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import load_map
from tests.worlds import CENTRE, l_room

WORLD = l_room()
SENSOR = Lidar.create(90, noise=0.01)
TRUE = np.array([0.12, -0.07, 1.2])
BASE = np.array([*(CENTRE + [-1.5, -0.1]), 0.0])
ODOMETRY = np.array([3.0, -40.0, 2.0])  # the odometry's own first pose
STRAIGHT, LEFT = (0.05, 0.0), (0.05, 0.083)  # [m], [rad] per scan
ROUND = [STRAIGHT] * 28 + [LEFT] * 19 + [STRAIGHT] * 28 + [LEFT] * 15
SETTINGS = {"window": 15, "rays": 90, "steps": 10}


def chain(start, steps):
    """Poses from a first one and the motions after it."""
    poses = [np.asarray(start)]
    for step in steps:
        x, y, theta = poses[-1]
        c, s = np.cos(theta), np.sin(theta)
        poses.append(
            np.array([x + c * step[0] - s * step[1], y + s * step[0] + c * step[1], 0])
        )
        poses[-1][2] = theta + step[2]
    return np.array(poses)


@jax.jit
def shoot(bases, twists, when, mount, key):
    """Scans whose rays are shot at `when` scan periods after the base was there."""

    def one(base, twist, key):
        ray = lambda t: geometry.compose(geometry.compose(base, t * twist), mount)
        cast = lambda t, b: raycast(WORLD, ray(t), b[None], SENSOR.range_max)[0]
        return SENSOR.measure(key, jax.vmap(cast)(when, SENSOR.bearings))

    return jax.vmap(one)(bases, twists, jax.random.split(key, len(bases)))


def drive(motions, seed, delay=0.0, sweep=0.0, travel=0.0):
    """Scans, odometry with a little slip, and the first pose of the lidar."""
    steps = np.array([[v, 0.0, w] for v, w in motions])
    bases = chain(BASE, steps[:-1])
    when = delay + sweep * np.arange(90) / 90
    scans = shoot(
        jnp.asarray(bases, float),
        jnp.asarray(steps, float),
        jnp.asarray(when, float),
        jnp.asarray(TRUE, float),
        jax.random.key(seed),
    )
    slip = np.random.default_rng(seed).normal(0, [2e-4, 1e-4, 5e-4], steps.shape)
    odometry = chain(ODOMETRY, (steps / [1 + travel, 1, 1] + slip)[:-1])
    start = geometry.compose(jnp.asarray(BASE, float), jnp.asarray(TRUE, float))
    return scans, odometry, np.asarray(start)


def misses(found, true=TRUE):
    off = np.asarray(found.pose_base_lidar - true, float)
    off[2] = np.angle(np.exp(1j * off[2]))
    return np.abs(off)


@pytest.mark.parametrize("turned", [20, -20])
def test_mounting_is_found_from_twenty_degrees_off(turned):
    scans, odometry, start = drive(ROUND, 1, delay=-0.3, sweep=1.0, travel=0.01)
    guess = [0.0, 0.0, TRUE[2] + np.deg2rad(turned)]
    config = MountingConfig(sweep=1.0, **SETTINGS)
    found = mounting(WORLD, scans, odometry, start, guess, config)
    # Six windows of 0.7 m, a slip of 1 mm and 0.1° in each: centimetres are not lost.
    assert np.all(misses(found) < [0.015, 0.015, np.deg2rad(0.5)])
    assert np.all(misses(found) < 3 * np.asarray(found.std))
    assert np.all(np.asarray(found.std) < [0.02, 0.02, np.deg2rad(0.5)])
    assert np.all(found.determined)
    assert found.converged
    assert abs(found.delay - -0.3) < 0.1
    assert abs(found.scales[0] - 0.01) < 0.01
    assert 0.007 < found.residual < 0.015


def test_sensor_without_sweep_and_a_true_odometry():
    scans, odometry, start = drive(ROUND, 2)
    known = MountingConfig(delay=0.0, stretch=0.0, travel=0.0, turn=0.0, **SETTINGS)
    found = mounting(WORLD, scans, odometry, start, [0.1, -0.1, 1.1], known)
    assert np.all(misses(found) < [0.01, 0.01, np.deg2rad(0.4)])
    assert np.all(misses(found) < 3 * np.asarray(found.std))
    assert abs(found.delay) < 1e-4  # deviation 0 means known
    assert np.all(np.abs(found.scales) < 1e-4)


def test_without_turns_x_and_y_stay_unknown():
    scans, odometry, start = drive([STRAIGHT] * 90, 3)
    found = mounting(
        WORLD, scans, odometry, start, [0.0, 0.0, 1.0], MountingConfig(**SETTINGS)
    )
    assert found.determined.tolist() == [False, False, True]
    assert np.all(found.std[:2] > 0.1)
    assert misses(found)[2] < 3 * found.std[2]


def test_standing_robot_tells_nothing():
    scans, odometry, start = drive([(0.0, 0.0)] * 90, 4)
    odometry = np.repeat(odometry[:1], 90, axis=0)
    found = mounting(
        WORLD, scans, odometry, start, [0.0, 0.0, 1.0], MountingConfig(**SETTINGS)
    )
    assert not np.any(found.determined)
    assert all(np.isfinite(leaf).all() for leaf in found)


def test_boundary():
    scans, odometry, start = drive(ROUND, 1)
    config = MountingConfig(**SETTINGS)
    few = jax.tree.map(lambda a: a[:44], scans)
    with pytest.raises(ValueError, match="at least 45 scans"):
        mounting(WORLD, few, odometry[:44], start, config=config)
    one = jax.tree.map(lambda a: a[0], scans)
    with pytest.raises(ValueError, match="stacked"):
        mounting(WORLD, one, odometry, start, config=config)
    with pytest.raises(ValueError, match="odometry must be finite"):
        mounting(WORLD, scans, odometry * np.nan, start, config=config)
    with pytest.raises(ValueError, match="guess"):
        mounting(WORLD, scans, odometry, start, [0, 0], config)
    with pytest.raises(ValueError, match="window"):
        mounting(WORLD, scans, odometry, start, config=MountingConfig(window=2))


def test_turtlebot_of_the_mac_log(data):
    """A twelfth of the rays, for the time it takes; `scripts/accuracy` asks for more."""
    log = np.load(data / "real" / "mac_turtlebot4_take2.npz")
    world = load_map(data / "real" / "mac_1st_floor_9_23.yaml")
    bearings = log["angle_min"] + log["angle_increment"] * np.arange(720)
    limits = float(log["range_min"]), float(log["range_max"])
    each = [Scan.from_bearings(r, bearings, *limits) for r in log["ranges"]]
    scans = jax.tree.map(lambda *a: jnp.stack(a), *each)
    config = MountingConfig(sweep=-1.0, rays=60, steps=12)
    start, true = log["pseudo_gt_laser_9_23"][0], log["laser_in_base"]
    guess = [0.0, 0.0, true[2] + np.deg2rad(20)]
    found = mounting(world, scans, log["odom_base"], start, guess, config)
    # The tf is a drawing's; 2 cm is the goal, and a degree what screws allow.
    assert np.all(misses(found, true) < [0.02, 0.02, np.deg2rad(1.0)])
    assert np.all(found.determined)
    matched = found.poses_map_lidar - log["pseudo_gt_laser_9_23"]
    assert np.median(np.hypot(*matched.T[:2])) < 0.03
