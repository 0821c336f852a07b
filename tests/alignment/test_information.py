"""Claims against errors: honest in simulation and on real maps, modest in corridors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.information import (
    covariance,
    cramer_rao_bound,
    degenerate_directions,
    fisher_information,
)
from fsmsm_jax.alignment.ros_pose import from_ros, to_ros
from fsmsm_jax.evaluation.metrics import nees, success
from fsmsm_jax.sensing import Lidar, Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap, load_map
from tests.alignment.simulated import (
    NOISE,
    POSE,
    SENSOR,
    assert_same,
    cast,
    few_rays,
    in_double,
    measure,
    office_poses,
    perturbed,
    room_poses,
    small_office,
    walls,
)
from tests.oracles.localisation import range_jacobian
from tests.worlds import CENTRE, l_room, rasterised_room, square_room, star

DRAWS = 250
REFERENCE = np.diag([0.01, 0.01, np.deg2rad(0.3)]) ** 2  # see scripts/accuracy

spread = jax.jit(covariance, static_argnames="floor")


def fit(world, scan, start):
    """A pose and its covariance."""
    pose, thickness = fit_ranges(world, scan, start, 8)
    return pose, covariance(world, scan, pose, thickness)


@jax.jit
def settle(world, scans, starts):
    """Poses and covariances of many fits; one world for all or one for each."""
    if jax.tree.leaves(world)[0].ndim == 3:
        return jax.lax.map(lambda args: fit(*args), (world, scans, starts))
    return jax.lax.map(lambda args: fit(world, *args), (scans, starts))


@pytest.mark.parametrize("sigma", [0.01, 0.1])
def test_claims_are_honest_in_rooms_of_all_shapes(sigma):
    """eᵀ C⁻¹ e of 250 fits is χ² with 3 · 250 degrees of freedom: 3 ± 0.15 (1σ).

    2.7 to 3.3 is what the project wants; two such standard errors.
    """
    rooms = [star(seed) for seed in range(DRAWS)]
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rooms)
    rng = np.random.default_rng(0)
    true = np.column_stack(
        [CENTRE + rng.uniform(-0.2, 0.2, (DRAWS, 2)), rng.uniform(-3, 3, DRAWS)]
    )
    true = jnp.asarray(true, float)
    sensor = Lidar.create(360, noise=sigma)
    keys = jax.random.split(jax.random.key(0), DRAWS)
    one = lambda a: sensor.measure(a[0], cast(a[1], a[2], sensor.bearings))
    scans = jax.lax.map(one, (keys, worlds, true))
    found, C = settle(worlds, scans, perturbed(true, 0.02, 0.02))
    squares = np.asarray(nees(found, true, C), float)
    assert 2.7 < squares.mean() < 3.3
    assert np.mean(squares < 7.81) == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize(
    ("kind", "honest"),
    [("square", 3), ("L", 3), ("grid", 3), ("slanted grid", 4), ("office", 5)],
)
def test_claims_are_honest_on_polygons_and_grids(kind, honest):
    """250 draws leave 0.15 (1σ) on the mean.

    At 1 cm of noise the corners of cells are felt: a grid's normals are those of its
    blurred walls, the fit loses a quarter against the bound, and the claim, made of the
    same normals, knows little of it.
    """
    pose = POSE
    if kind in ("square", "L"):
        world = square_room() if kind == "square" else l_room()
    elif kind == "office":
        world = small_office()
    else:
        world, twin = rasterised_room(0.0 if kind == "grid" else 0.3)
        pose = jnp.append(twin.start.mean(axis=0) + jnp.array([0.7, -0.4]), 0.6)
    true = jnp.tile(pose, (DRAWS, 1))
    if kind == "office":
        true = office_poses(world, DRAWS)
    scans = measure(world, SENSOR, true, jax.random.key(0))
    found, C = settle(world, scans, perturbed(true, 0.02, 0.02))
    squares = np.asarray(nees(found, true, C), float)
    assert 3 - 4 * 0.15 < squares.mean() < honest + 4 * 0.15


@pytest.mark.parametrize(
    ("name", "map_name", "uncertain"),
    [
        ("mac_turtlebot4_take2", "mac_1st_floor_9_23", False),
        ("freiburg-079", "freiburg-079", True),
    ],
)
def test_claims_are_honest_on_real_maps(data, name, map_name, uncertain):
    """Scans that the map does not know, 1.5 to 6 on average.

    The SLAM-corrected reference of freiburg-079 is itself off: by 1.4 cm and 0.5° from
    scan to scan, against a fit of scan to scan, where our fits are off by 0.4 cm and
    0.15°. 1 cm and 0.3° are granted.
    """
    log = np.load(data / "real" / f"{name}.npz")
    poses = log["poses"] if "poses" in log else log["pseudo_gt_laser_9_23"]
    unseen = ~log["in_map"] if "in_map" in log else np.ones(len(poses), bool)
    picked = np.flatnonzero(unseen)[:: unseen.sum() // 32][:32]
    limit = float(log["range_max"]) if "range_max" in log else 50.0
    angles = float(log["angle_min"]), float(log["angle_increment"])
    one = lambda n: Scan.from_ranges(log["ranges"][n], *angles, 0.02, limit)
    scans = jax.tree.map(lambda *a: jnp.stack(a), *[one(n) for n in picked])
    true = jnp.asarray(poses[picked], float)
    world = load_map(data / "real" / f"{map_name}.yaml")
    found, C = settle(world, scans, perturbed(true, 0.05, 0.03))
    right = np.asarray(success(found, true))
    assert right.mean() > 0.9
    C = C + uncertain * jnp.asarray(REFERENCE, float)[None]
    assert 1.5 < np.asarray(nees(found, true, C))[right].mean() < 6


@pytest.mark.parametrize(("world", "floor"), [(square_room(), 0.004), (l_room(), 0.02)])
def test_covariance_without_noise_is_the_inverse_information(world, floor):
    """σ is the floor and nothing is shared: the bound remains, but for the jackknife.

    Rays so slanted that their derivative is capped are left out.
    """
    exact = cast(world, POSE, SENSOR.bearings)
    bearings = np.asarray(SENSOR.bearings, float)
    J = range_jacobian(*walls(world), np.asarray(POSE, float), bearings)
    flat = J[:, 3] < 9
    said = jnp.asarray(flat)
    scan = Scan(exact, SENSOR.bearings, said, said, SENSOR.range_max)
    J = J[flat, :3] / floor
    bound = np.linalg.inv(J.T @ J)
    lever = np.einsum("ni,ij,nj->n", J, bound, J)
    scatter = (J / (1 - lever[:, None]) ** 2).T @ J
    freedom = 1 - np.trace(bound @ scatter) / flat.sum()  # (n − 3) / n, about
    expected = bound @ scatter @ bound / freedom
    found = np.asarray(spread(world, scan, POSE, floor=floor), float)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.01)


def test_information_adds_up_and_its_inverse_is_the_bound():
    world, rays = l_room(), SENSOR.bearings
    whole = fisher_information(world, POSE, rays, 30.0, NOISE)
    halves = [fisher_information(world, POSE, rays[k::2], 30.0, NOISE) for k in (0, 1)]
    np.testing.assert_allclose(whole, sum(halves), rtol=1e-4, atol=1.0)
    bound = cramer_rao_bound(world, POSE, rays, 30.0, NOISE)
    np.testing.assert_allclose(bound @ whole, np.eye(3), atol=1e-3)


def test_covariance_turns_with_the_world():
    """Position block R C Rᵀ, and the heading's variance as before."""
    world, turn = l_room(), 0.9
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    move = lambda points: jnp.asarray(np.asarray(points, float) @ R.T + [3, -8], float)
    turned = PolygonMap(move(world.start), move(world.end))
    pose = jnp.append(move(POSE[:2]), POSE[2] + turn)
    scan = SENSOR.measure(jax.random.key(0), cast(world, POSE, SENSOR.bearings))
    here, there = spread(world, scan, POSE), spread(turned, scan, pose)
    R = np.block([[R, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])
    scale = float(jnp.max(jnp.abs(here)))
    np.testing.assert_allclose(R @ here @ R.T, there, atol=0.01 * scale)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.4])
def test_a_corridor_hides_where_along_it_one_stands(yaw):
    """Two walls 2 m apart, their ends out of sight."""
    corners = np.array([[-100, -1], [100, -1], [100, 1], [-100, 1]])
    along = np.array([np.cos(yaw), np.sin(yaw)])
    across = np.array([-along[1], along[0]])
    R = np.column_stack([along, across])
    world = PolygonMap.from_outlines(corners @ R.T + CENTRE)
    pose = jnp.asarray([*(CENTRE + R @ [2.0, 0.2]), 1.0], float)
    scan = SENSOR.measure(jax.random.key(0), cast(world, pose, SENSOR.bearings))
    assert not scan.echo.all()  # the ends
    found, C = jax.tree.map(
        lambda a: a[0], settle(world, jax.tree.map(lambda a: a[None], scan), pose[None])
    )
    directions = degenerate_directions(C)
    C = np.asarray(C, float)
    assert along @ C[:2, :2] @ along > 5.0**2
    assert across @ C[:2, :2] @ across < 0.01**2
    assert C[2, 2] < np.deg2rad(1) ** 2
    moved = np.asarray(found - pose, float)[:2]
    assert abs(moved @ across) < NOISE / 2
    assert directions.degenerate.tolist() == [True, False, False]
    assert directions.sigma[0] > 5
    assert abs(directions.axes[0, :2] @ along) == pytest.approx(1, abs=1e-3)


def test_a_round_room_hides_the_heading():
    angles = 2 * np.pi * np.arange(360) / 360
    circle = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=-1) + CENTRE
    world = PolygonMap.from_outlines(circle)
    pose = jnp.asarray([*CENTRE, 0.0], float)
    middles = jnp.asarray(angles + np.pi / 360, float)
    directions = degenerate_directions(
        cramer_rao_bound(world, pose, middles, 30.0, 0.05)
    )
    assert directions.degenerate.tolist() == [True, False, False]
    np.testing.assert_allclose(np.abs(directions.axes[0]), [0, 0, 1], atol=1e-2)
    wide = degenerate_directions(jnp.diag(jnp.array([1e-4, 1e-4, 0.04])), radius=10.0)
    assert wide.sigma[0] == pytest.approx(2.0)  # 0.2 rad, 10 m away
    np.testing.assert_allclose(np.abs(wide.axes[0]), [0, 0, 0.1], atol=1e-6)


def test_ros_takes_it_and_gives_it_back():
    C = np.array([[4.0, 1, 0.1], [1, 3, 0.2], [0.1, 0.2, 0.5]])
    sent = to_ros(C)
    assert [sent[0], sent[1], sent[5], sent[35]] == [4.0, 1.0, 0.1, 0.5]
    assert np.count_nonzero(sent) == 9
    np.testing.assert_array_equal(from_ros(sent), C)
    np.testing.assert_array_equal(from_ros(np.reshape(sent, (6, 6))), C)
    np.testing.assert_array_equal(from_ros(to_ros(jnp.asarray(C))), C.astype("f4"))
    with pytest.raises(ValueError, match="36 numbers"):
        from_ros([0.0] * 9)


@pytest.mark.parametrize(
    ("fov", "noise", "outliers"), [(2 * np.pi, 0.01, 0.3), (0.5, 0.05, 0.0)]
)
def test_covariance_is_symmetric_and_positive_definite(fov, noise, outliers):
    world, poses = l_room(), room_poses(24)
    sensor = Lidar.create(180, fov, noise=noise, outliers=outliers)
    scans = measure(world, sensor, poses, jax.random.key(4))
    C = np.asarray(settle(world, scans, poses)[1], float)
    size = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    scaled = C / size[:, :, None] / size[:, None, :]
    np.testing.assert_allclose(scaled, np.swapaxes(scaled, 1, 2), atol=1e-4)
    assert np.linalg.eigvalsh(scaled).min() > 0


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_few_rays_give_no_nan_and_no_false_certainty(count):
    scan = few_rays(l_room(), count)
    for pose in (POSE, POSE + 0.03):
        C = np.asarray(spread(l_room(), scan, pose), float)
        assert np.isfinite(C).all()
        assert np.linalg.eigvalsh(C).min() > 0
        if count < 3:  # three unknowns, fewer measurements
            assert np.linalg.eigvalsh(C).max() > 1


def test_a_map_of_nothing_says_nothing():
    empty = np.zeros((240, 240), int)
    empty = OccupancyGrid.from_cells(empty, 0.05, (3.0, 4.0, 0.5))
    pose = jnp.array([4.0, 8.5, 0.2])
    exact = cast(empty, pose, SENSOR.bearings)
    scan = SENSOR.measure(jax.random.key(0), exact)
    assert not scan.echo.any()
    assert degenerate_directions(spread(empty, scan, pose)).degenerate.all()


def test_jit_vmap_and_precision_change_nothing():
    """σ rests on a median of millimetres, whose rounding counts for some per mille."""
    world, true, close = l_room(), room_poses(5), {"rtol": 0.02, "atol": 1e-9}
    scans = measure(world, SENSOR, true, jax.random.key(3))
    many = jax.jit(jax.vmap(covariance, (None, 0, 0)))(world, scans, true)
    for i in range(len(true)):
        scan, pose = jax.tree.map(lambda a, i=i: a[i], (scans, true))
        assert_same(many[i], spread(world, scan, pose), **close)
    assert_same(covariance(world, scan, pose), spread(world, scan, pose), **close)
    given = jax.tree.map(np.asarray, (world, scan, pose))
    with jax.enable_x64(True):
        double = jax.jit(covariance)(*in_double(given))
        assert double.dtype == jnp.float64
        double = np.asarray(double)
    np.testing.assert_allclose(double, double.T, rtol=1e-9)
    assert_same(many[-1], double, **close)
