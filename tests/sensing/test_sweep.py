"""Scans taken on the way: arcs against the matrix exponential, and scans put right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm

from fsmsm_jax import geometry
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.sensing.sweep import fraction, moments, unswept
from tests.worlds import CENTRE, l_room

MOTIONS = {
    "none": [0.0, 0.0, 0.0],
    "straight": [0.4, -0.1, 0.0],
    "nearly straight": [0.4, -0.1, 9e-5],  # just on the chord's side of the switch
    "hardly bent": [0.4, -0.1, -2e-4],  # and just on the arc's
    "bend": [0.3, 0.05, 0.4],
    "backwards": [-0.3, 0.02, -0.2],
    "on the spot": [0.0, 0.0, -1.2],
    "nearly about": [0.2, 0.3, 3.1],
    "about": [0.1, -0.2, 3.1415],
}
SHARES = [0.0, 0.25, 0.5, 1.0, -0.3, -1.0, 1.2]
# Float32 rounds a heading of 3 rad to 2e-7; some ten operations on half a metre.
CLOSE = 3e-6
MOTION = jnp.asarray([0.25, -0.04, 0.5])
RAYS = 90
fraction_, unswept_ = jax.jit(fraction), jax.jit(unswept)
slope_of = jax.jit(jax.jacrev(fraction, (0, 1)))


def matrix(pose):
    x, y, theta = np.asarray(pose, float)
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def assert_same_pose(found, expected, atol):
    off = np.asarray(found, float) - np.asarray(expected, float)
    off[2] = np.angle(np.exp(1j * off[2]))
    np.testing.assert_allclose(off, 0.0, atol=atol)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_fractions_are_powers_of_the_motion(motion):
    """exp(m log M), by scipy. A chord for an arc of 1e-4 rad is off by θ d / 8 at most."""
    twist = np.real(logm(matrix(motion)))
    for share in SHARES:
        found = fraction_(jnp.asarray(motion), jnp.asarray(share))
        power = expm(share * twist)
        expected = [*power[:2, 2], np.arctan2(power[1, 0], power[0, 0])]
        assert_same_pose(found, expected, atol=CLOSE if abs(motion[2]) < 3 else 3e-5)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_fractions_add_up(motion):
    motion = jnp.asarray(motion)
    part = lambda share: fraction_(motion, jnp.asarray(share))
    assert_same_pose(part(1.0), motion, CLOSE)
    assert_same_pose(part(0.0), np.zeros(3), 1e-7)
    assert_same_pose(part(-1.0), geometry.inverse(motion), CLOSE)
    for a, b in ((0.3, 0.7), (0.45, -0.45), (-0.2, -0.6)):
        assert_same_pose(geometry.compose(part(a), part(b)), part(a + b), CLOSE)


def test_headings_beyond_pi_are_the_same_turn():
    for turn in (0.4, -2.5):
        motion = jnp.asarray([0.3, 0.1, turn])
        wound = motion.at[2].add(2 * jnp.pi)
        half = jnp.asarray(0.5)
        assert_same_pose(fraction_(wound, half), fraction_(motion, half), CLOSE)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_fractions_have_derivatives(motion):
    """At no motion a share m of the motion is linear in it: m I."""
    slope = slope_of(jnp.asarray(motion), jnp.asarray(0.3))
    assert all(np.isfinite(part).all() for part in slope)
    if not any(motion):
        np.testing.assert_allclose(slope[0], 0.3 * np.eye(3), atol=1e-6)


def test_float64_stays():
    with jax.enable_x64(True):
        motion = jnp.asarray(MOTIONS["bend"], jnp.float64)
        found = fraction(motion, jnp.asarray(0.3))
        assert found.dtype == jnp.float64
        power = expm(0.3 * np.real(logm(matrix(motion))))
        np.testing.assert_allclose(found[:2], power[:2, 2], atol=1e-12)


@pytest.fixture(scope="module")
def swept():
    """A scan of the L-room whose rays are cast one after the other on the way.

    Its twin is cast all at once at the end; rays 60 and later point where it is clear
    of walls within the range, or are lost.
    """
    world = l_room()
    pose = jnp.asarray([*CENTRE, 0.8])
    lidar = Lidar.create(RAYS, range_max=4.0, noise=0.0)
    when = jnp.linspace(-1.0, 0.0, RAYS)

    @jax.jit
    @jax.vmap
    def cast(moment, bearing):
        there = geometry.compose(pose, fraction(MOTION, moment))
        return raycast(world, there, bearing[None], lidar.range_max)[0]

    exact = cast(when, lidar.bearings)
    scan = lidar.measure(jax.random.key(0), exact)
    lost = jnp.arange(RAYS) % 11 == 3
    scan = Scan(
        jnp.where(lost, scan.range_max, scan.ranges), scan.bearings,
        scan.valid & ~lost, scan.echo & ~lost, scan.range_max,
    )  # fmt: skip
    return world, pose, scan, when


def test_end_points_are_put_back_on_the_walls(swept):
    """To 1e-4 m: a ray's heading of 3 rad and its place are rounded by some 1e-6."""
    world, pose, scan, when = swept
    echo = np.asarray(scan.echo)
    assert 20 < echo.sum() < RAYS - 15
    off = lambda scan: np.asarray(
        world.distance_at(geometry.transform_points(pose, scan.points))
    )[echo]
    assert np.median(off(scan)) > 0.03  # it was smeared
    assert off(unswept_(scan, MOTION, when)).max() < 1e-4


def test_rays_that_stay_in_sight_read_what_the_end_pose_reads(swept):
    world, pose, scan, when = swept
    found = unswept_(scan, MOTION, when)
    exact = raycast(world, pose, found.bearings, scan.range_max)
    same = np.abs(np.asarray(found.ranges - exact))[np.asarray(scan.echo)] < 1e-3
    assert same.mean() > 0.85  # the rest is hidden behind the corner by then


def test_what_is_no_echo_stays_none(swept):
    _, _, scan, when = swept
    found = unswept_(scan, MOTION, when)
    none = ~np.asarray(scan.echo)
    np.testing.assert_array_equal(found.valid, scan.valid)
    np.testing.assert_array_equal(found.echo, scan.echo)
    np.testing.assert_array_equal(found.ranges[none], scan.range_max)
    turned = geometry.wrap(scan.bearings + MOTION[2] * when)
    off = np.asarray(geometry.wrap(found.bearings - turned))[none]
    np.testing.assert_allclose(off, 0.0, atol=CLOSE)
    assert (np.asarray(found.ranges) <= float(scan.range_max)).all()
    assert (np.abs(np.asarray(found.bearings)) <= np.pi).all()


def test_a_robot_that_stands_and_a_scan_of_one_moment_change_nothing(swept):
    _, _, scan, when = swept
    for motion, moments_ in ((jnp.zeros(3), when), (MOTION, jnp.zeros(RAYS))):
        found = unswept_(scan, motion, moments_)
        np.testing.assert_allclose(found.ranges, scan.ranges, atol=CLOSE)
        off = np.asarray(geometry.wrap(found.bearings - scan.bearings))
        np.testing.assert_allclose(off, 0.0, atol=CLOSE)


def test_jit_vmap_and_gradients(swept):
    _, _, scan, when = swept
    found = unswept_(scan, MOTION, when)
    eager = unswept(scan, MOTION, when)
    np.testing.assert_allclose(eager.ranges, found.ranges, atol=CLOSE)
    two = jax.vmap(unswept, (None, 0, None))(scan, jnp.stack([MOTION, -MOTION]), when)
    np.testing.assert_allclose(two.ranges[0], found.ranges, atol=CLOSE)
    total = lambda motion: jnp.sum(unswept(scan, motion, when).points ** 2)
    slope = jax.jit(jax.grad(total))
    for motion in (MOTION, jnp.zeros(3)):
        assert np.isfinite(slope(motion)).all()


TIMES = np.array([[0.0, 0.05, 0.1]])


def found_moments(stamps, ray_times=TIMES):
    stamps = np.asarray(stamps, float)
    return moments(stamps, np.broadcast_to(ray_times, (len(stamps), 3)))


def test_moments_count_intervals():
    found = found_moments([10.0, 10.2, 10.3])
    np.testing.assert_allclose(found, [[0, 0, 0], [0, 0.25, 0.5], [0, 0.5, 1.0]])
    before = found_moments([10.0, 10.2], -TIMES)
    np.testing.assert_allclose(before[1], [0, -0.25, -0.5])


@pytest.mark.parametrize(
    "stamps",
    [[5.0, 5.0], [5.0, 4.9], [5.0, 6.5], [5.0, np.nan], [np.nan, 5.0]],
    ids=["still", "backwards", "gap", "unknown", "after unknown"],
)
def test_unusable_intervals_leave_the_scan_alone(stamps):
    """And the next interval counts again."""
    found = found_moments([*stamps, stamps[-1] + 0.2])
    np.testing.assert_array_equal(found[:2], 0.0)
    if np.isfinite(stamps[-1]):
        np.testing.assert_allclose(found[2], TIMES[0] / 0.2, rtol=1e-6)


def test_rays_without_a_time():
    times = np.array([[0.0, np.nan, 0.1]])
    np.testing.assert_allclose(found_moments([1.0, 1.2], times)[1], [0, 0, 0.5])


def test_one_scan_has_no_interval():
    np.testing.assert_array_equal(found_moments([3.0]), 0.0)
