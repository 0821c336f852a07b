import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation import odometer
from fsmsm_jax.localisation.keyframe_match import KeyframeMatchConfig
from fsmsm_jax.localisation.keyframes import cast, look_up, none_yet, with_keyframe
from fsmsm_jax.localisation.lidar_odometry import lidar_odometry
from fsmsm_jax.localisation.odometer import LidarOdometryConfig
from fsmsm_jax.sensing import Lidar, panorama, raycast
from fsmsm_jax.world import PolygonMap

SCANS, NOISE = 48, 0.01
LIDAR = Lidar.create(180, field_of_view=4.0, range_max=15.0, noise=NOISE)
SMALL = LidarOdometryConfig(
    rays=180, match=KeyframeMatchConfig(rays=180, scouts=60, headings=6, steps=4)
)


def box(x, y, width, height):
    return [[x, y], [x + width, y], [x + width, y + height], [x, y + height]]


# Two rooms and a door, with cupboards, away from the origin.
OUTLINE = [
    *([40, -30], [45, -30], [45, -27.5], [45.3, -27.5], [45.3, -30], [51, -30]),
    *([51, -24], [45.3, -24], [45.3, -26], [45, -26], [45, -24.5], [40, -25]),
]
CUPBOARDS = [box(42, -29.9, 1.0, 0.5), box(48, -25, 0.8, 0.6), box(49.5, -29, 0.6, 0.9)]
HOUSE = PolygonMap.from_outlines(OUTLINE, *CUPBOARDS)
HALL = PolygonMap.from_outlines(box(-300, 5, 900, 2.0))  # longer than anybody sees


def drive(scans=SCANS):
    """From one room through the door into the other, turning to and fro."""
    n = np.arange(scans)
    x = 41.5 + 6.5 * n / scans
    y = -26.8 - 0.15 * np.sin(n / 6)
    return jnp.asarray(np.stack([x, y, 0.5 * np.sin(n / 5)], axis=1), float)


def seen(world, poses, seed=0, lidar=LIDAR):
    keys = jax.random.split(jax.random.key(seed), len(poses))
    exact = jax.vmap(raycast, (None, 0, None, None))(
        world, poses, lidar.bearings, lidar.range_max
    )
    return jax.vmap(lidar.measure)(keys, exact)


def from_the_first(poses):
    return np.asarray(jax.vmap(geometry.between, (None, 0))(poses[0], poses), float)


def errors(found, true):
    off = np.asarray(found, float) - true
    turn = np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi
    return np.hypot(off[:, 0], off[:, 1]), np.abs(turn)


def edited(scans, row=None, **leaves):
    """The scans, some leaves replaced, in one row or in all."""
    names = ("ranges", "bearings", "valid", "echo", "range_max")
    old = {name: getattr(scans, name) for name in names}
    for name, value in leaves.items():
        old[name] = value if row is None else old[name].at[row].set(value)
    return jax.tree.unflatten(jax.tree.structure(scans), list(old.values()))


@pytest.fixture(scope="module")
def driven():
    poses = drive()
    scans = seen(HOUSE, poses)
    return scans, from_the_first(poses), lidar_odometry(scans, SMALL)


def test_the_way_is_known_to_a_centimetre_or_two(driven):
    _, true, found = driven
    metres, radians = errors(found.pose, true)
    # 6.5 m, some 14 keyframes, each known to a few mm: a random walk of them.
    assert metres.max() < 0.03
    assert radians.max() < np.deg2rad(0.6)
    assert found.status[0] == "keyframe"
    assert set(found.status) == {"keyframe", "matched"}
    assert 5 < np.sum(found.status == "keyframe") < SCANS // 2
    np.testing.assert_allclose(found.deviation[1:], NOISE, rtol=0.6)


def test_the_covariance_is_honest_and_grows(driven):
    _, true, found = driven
    off = found.pose[1:] - true[1:]
    solved = np.linalg.solve(found.covariance[1:].astype(float), off[..., None])
    nees = np.sum(off * solved[..., 0], axis=1)
    # Poses share the errors of their keyframes: no χ² of so many, but of its size.
    assert nees.mean() < 3 * 3
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert (sigma[-1] > 1.5 * sigma[2]).all()
    assert sigma[-1, :2].max() < 0.05


def test_steps_are_the_run_and_lanes_are_alone(driven):
    scans, _, found = driven
    few = jax.tree.map(lambda a: a[:6], scans)
    state = odometer.init(SMALL)
    for n in range(6):
        scan = jax.tree.map(lambda a, n=n: a[n], few)
        state, info = odometer.step(state, scan, SMALL)
        # Programs differ in the order of sums: float32's rounding of some metres.
        np.testing.assert_allclose(info.pose, found.pose[n], atol=2e-4)
    other = jax.tree.map(lambda a: a[20:26], scans)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), few, other)
    run = lambda scans: odometer.run(odometer.init(SMALL), scans, SMALL)[1].pose
    lanes = jax.vmap(run)(both)
    np.testing.assert_allclose(lanes[0], found.pose[:6], atol=2e-4)
    alone = from_the_first(drive()[20:26])
    np.testing.assert_allclose(lanes[1], alone, atol=0.02)


def test_standing_still_does_not_drift():
    still = seen(HOUSE, jnp.tile(drive()[:1], (SCANS, 1)), seed=5)
    found = lidar_odometry(still, SMALL)
    # One keyframe, and each pose as good as its own scan; no walk of them.
    assert np.sum(found.status == "keyframe") == 1
    metres, radians = errors(found.pose, np.zeros(3))
    assert metres.max() < 0.012
    assert metres[-8:].mean() < 2 * metres[1:9].mean() + 1e-3
    assert radians.max() < np.deg2rad(0.4)


def test_a_sudden_turn_is_found_and_a_blind_scan_is_skipped(driven):
    scans, true, _ = driven
    poses = drive().at[20:, 2].add(np.deg2rad(40))
    scans = seen(HOUSE, poses, seed=2)
    nothing = jnp.zeros(180, bool)
    scans = edited(scans, 10, valid=nothing, echo=nothing, ranges=15.0)
    found = lidar_odometry(scans, SMALL)
    assert found.status[10] == "skipped"
    assert np.isfinite(found.covariance).all()
    before, now = jnp.asarray(found.pose[8:10])
    goes_on = geometry.compose(now, geometry.between(before, now))
    np.testing.assert_allclose(found.pose[10], goes_on, atol=1e-5)
    metres, radians = errors(found.pose, from_the_first(poses))
    assert metres.max() < 0.05
    # After the turn a third of the view is new, and what is shared is one keyframe.
    assert radians.max() < np.deg2rad(2.0)


def test_along_a_bare_corridor_it_goes_on_and_says_that_it_does_not_know():
    n = np.arange(SCANS)
    poses = jnp.asarray(np.stack([20 + 0.0 * n, 5.7 + 0.004 * n, 0.0 * n], axis=1))
    found = lidar_odometry(seen(HALL, poses.astype(float), seed=3), SMALL)
    # Across, every ray speaks. Along, none does: noise may push a little, and nothing
    # may add that up to a run (without `weakest`, it was 60 m by now).
    np.testing.assert_allclose(found.pose[:, 1], 0.004 * n, atol=0.012)
    sigma = np.sqrt(np.diagonal(found.covariance[-1]))
    assert sigma[0] > 20 * sigma[1]
    assert np.abs(found.pose[:, 0]).max() < 5.0


def test_how_the_lidar_is_mounted_does_not_matter(driven):
    scans, true, found = driven
    turned = edited(scans, bearings=scans.bearings - np.pi / 2)
    mount = jnp.array([0.0, 0.0, np.pi / 2])
    other = jax.vmap(
        lambda pose: geometry.compose(
            geometry.compose(mount, pose), geometry.inverse(mount)
        )
    )(jnp.asarray(lidar_odometry(turned, SMALL).pose))
    # The same scans and, at a right angle, the same rays of outlines.
    np.testing.assert_allclose(other, found.pose, atol=5e-3)


def test_double_precision_says_the_same(driven):
    _, _, found = driven
    with jax.enable_x64(True):
        lidar = Lidar.create(180, field_of_view=4.0, range_max=15.0, noise=0.0)
        world = PolygonMap.from_outlines(OUTLINE, *CUPBOARDS)
        poses = jnp.asarray(np.asarray(drive()[:4], float))
        double = lidar_odometry(seen(world, poses, lidar=lidar), SMALL)
        assert double.pose.dtype == np.float64
        metres, radians = errors(double.pose, from_the_first(poses))
    # Without noise, corners that outlines cut are what is left.
    assert metres.max() < 5e-3
    assert radians.max() < np.deg2rad(0.1)
    assert found.pose.dtype == np.float32


@pytest.mark.parametrize("ask", [look_up, cast])
def test_residuals_are_nought_at_the_truth_and_fall_as_their_derivative(ask):
    lidar = Lidar.create(180, field_of_view=4.0, range_max=15.0, noise=0.0)
    poses = drive()[jnp.array([0, 3, 6])]
    scans = seen(HOUSE, poses, lidar=lidar)
    keep = jax.jit(lambda f, scan, pose: with_keyframe(f, panorama(scan, 360), pose))
    ask = jax.jit(ask)
    frames = none_yet(3, 360)
    for n in range(2):
        scan = jax.tree.map(lambda a, n=n: a[n], scans)
        frames = keep(frames, scan, poses[n])
    last = jax.tree.map(lambda a: a[2], scans)
    e, J, known = ask(frames, last, poses[2])
    assert not known[2].any()  # room that is not filled
    assert known[:2].sum() > 200
    # Edges of cupboards are cut by outlines; walls are not.
    assert np.median(np.abs(e[known])) < 2e-3
    step = jnp.array([0.004, -0.003, 0.002])
    there, _, still = ask(frames, last, poses[2] + step)
    both = np.asarray(known & still & (jnp.abs(e) < 0.01))
    left = np.asarray(there - (e - J @ step))[both]
    assert np.quantile(np.abs(left), 0.8) < 1e-3


def test_wrong_input_is_said_to_be_wrong(driven):
    scans, _, _ = driven
    one = jax.tree.map(lambda a: a[0], scans)
    for wrong, message in (
        (one, "stacked along a leading axis"),
        (jax.tree.map(lambda a: a[:0], scans), "scans ≥ 1"),
        (edited(scans, bearings=scans.bearings[:, 1:]), "must have shape"),
        (edited(scans, 3, range_max=9.0), "one finite range_max"),
    ):
        with pytest.raises(ValueError, match=message):
            lidar_odometry(wrong, SMALL)
    for settings in ({"keyframes": 0}, {"rays": 7}):
        with pytest.raises(ValueError, match="at least 8 rays"):
            LidarOdometryConfig(**settings)
    with pytest.raises(ValueError, match="count from 1"):
        KeyframeMatchConfig(steps=0)
