"""`match`: real-looking scans, dirty scans, moved worlds, and what is refused."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

import fsmsm_jax as fj
from fsmsm_jax import geometry
from fsmsm_jax.alignment import (
    FastConfig,
    FsmsmConfig,
    fast_match,
    match,
    match_batch,
)
from fsmsm_jax.evaluation.metrics import pose_errors
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap, buildings
from tests.worlds import CENTRE, free_poses, l_room, star

NOISE = 0.01
RAYS = 120  # of the sensors and of the panoramas: few programs, quickly compiled
FULL = Lidar.create(RAYS, noise=NOISE)
ROOM = l_room()
TRUTH = np.array([*(CENTRE + [0.6, 0.3]), 2.8])  # so that the heading wraps
NEAR = TRUTH + [0.12, -0.1, 0.5]
ONE_LEVEL = {"levels": (2,), "translations": (5,)}  # each compiles as long again


def off(found, truth):
    """Metres and degrees."""
    metres, radians = pose_errors(jnp.asarray(found), jnp.asarray(truth, float))
    return np.asarray(metres), np.rad2deg(np.asarray(radians))


@jax.jit
def measure(world, pose, lidar, key):
    return lidar.measure(key, raycast(world, pose, lidar.bearings, lidar.range_max))


def scan_of(world, pose, lidar=FULL, seed=0):
    return measure(world, jnp.asarray(pose, float), lidar, jax.random.key(seed))


def stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def pick(tree, index):
    return jax.tree.map(lambda a: a[index], tree)


def around(truth, seed=0, offset=0.2, turn=np.pi / 4):
    rng = np.random.default_rng(seed)
    return truth + rng.uniform(-1, 1, truth.shape) * [offset, offset, turn]


def match_room(world=ROOM, scan=None, pose=NEAR, **options):
    scan = scan_of(ROOM, TRUTH) if scan is None else scan
    return match(world, scan, pose, rays=RAYS, **options)


@pytest.fixture(scope="module")
def office():
    """A building that lies turned in the map, and 16 poses 0.4 m clear of its walls."""
    cells = np.asarray(buildings.office(seed=1, width=15, height=10).cells)
    world = OccupancyGrid.from_cells(cells, 0.05, (20.0, -30.0, 0.7))
    poses = free_poses(world, 400, seed=3)
    clear = np.asarray(world.distance_at(jnp.asarray(poses[:, :2], float))) > 0.4
    return world, poses[clear][:16]


@pytest.mark.parametrize(
    ("degrees", "turn", "floor"), [(360, 45, 0.95), (270, 45, 0.9), (180, 45, 0.85)]
)
def test_finds_the_pose_in_a_building(office, degrees, turn, floor):
    world, truth = office
    lidar = Lidar.create(RAYS, np.deg2rad(degrees), noise=NOISE)
    scans = stack([scan_of(world, pose, lidar, i) for i, pose in enumerate(truth)])
    starts = around(truth, turn=np.deg2rad(turn))
    found = match_batch(world, scans, starts, rays=RAYS)
    metres, angle = off(found.pose, truth)
    right = (metres < 0.1) & (angle < 2)
    assert right.mean() >= floor
    assert np.median(metres) < NOISE
    assert np.median(angle) < 0.3
    assert np.asarray(found.converged)[right].mean() > 0.9
    spread = np.asarray(found.covariance)
    np.testing.assert_array_equal(spread, spread.swapaxes(1, 2))
    assert (np.linalg.eigvalsh(spread.astype(float)) > 0).all()
    away = np.asarray(found.pose - truth)[right, :2]
    sigmas = np.einsum("ni,nij,nj->n", away, np.linalg.inv(spread[right, :2, :2]), away)
    assert np.median(sigmas) < 8  # 1.4 if all were Gaussian and known


def test_a_pose_in_a_room_and_all_that_is_said_of_it():
    found = match_room()
    metres, angle = off(found.pose, TRUTH)
    assert metres < NOISE
    assert angle < 0.3
    assert found.pose.dtype == jnp.result_type(float)
    assert bool(found.converged)
    assert found.caer_per_ray < 1.5 * NOISE < found.caer_before
    scan = scan_of(ROOM, TRUTH)
    assert RAYS * found.caer_per_ray == pytest.approx(
        float(fj.caer(ROOM, scan, found.pose)), rel=1e-4
    )
    assert 0 < found.iterations < found.scans


def test_a_batch_is_a_loop():
    truth = around(np.tile(TRUTH, (5, 1)), seed=2)
    scans = [scan_of(ROOM, pose, seed=i) for i, pose in enumerate(truth)]
    starts = around(truth, seed=3, offset=0.1, turn=0.4)
    batch = match_batch(ROOM, stack(scans), starts, rays=RAYS)
    many = match_batch(stack([ROOM] * 5), stack(scans), starts, rays=RAYS)
    for i, (scan, start) in enumerate(zip(scans, starts, strict=True)):
        alone = match_room(scan=scan, pose=start)
        for found in (pick(batch, i), pick(many, i)):
            np.testing.assert_allclose(found.pose, alone.pose, atol=2e-5)
            np.testing.assert_allclose(found.covariance, alone.covariance, rtol=0.05)
            assert found.converged == alone.converged


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(-3, 3))
@settings(max_examples=10)
def test_a_moved_world_moves_the_answer(x, y, turn):
    moved = jnp.array([x, y, turn])
    there = PolygonMap(
        geometry.transform_points(moved, ROOM.start),
        geometry.transform_points(moved, ROOM.end),
    )
    pose = lambda p: geometry.compose(moved, jnp.asarray(p, float))
    found = match_room(there, pose=pose(NEAR))
    metres, angle = off(found.pose, pose(match_room().pose))
    assert metres < 1e-3  # the same noise: float32 at 40 m, and where a step ends
    assert angle < 0.05


def test_a_turned_sensor_stands_in_the_same_place():
    """Whole rays, so that the panorama says the same."""
    scan, turn = scan_of(ROOM, TRUTH), 2 * np.pi * 17 / RAYS
    turned = Scan(
        scan.ranges, scan.bearings + turn, scan.valid, scan.echo, scan.range_max
    )
    here, there = match_room(), match_room(scan=turned, pose=NEAR - [0, 0, turn])
    metres, angle = off(there.pose.at[2].add(turn), here.pose)
    assert metres < 1e-3
    assert angle < 0.05


def test_float32_is_near_float64():
    single, ranges = match_room(), np.asarray(scan_of(ROOM, TRUTH).ranges)
    with jax.enable_x64(True):
        scan = Scan.from_ranges(ranges, -np.pi, 2 * np.pi / RAYS)
        double = match(l_room(), scan, NEAR, rays=RAYS)
        assert double.pose.dtype == jnp.float64
    metres, angle = off(single.pose, np.asarray(double.pose))
    assert metres < 1e-3
    assert angle < 0.05


def test_other_numbers_do_not_compile_again(monkeypatch):
    traces = []

    def counted(*args, **options):
        traces.append(args)
        return fast_match(*args, **options)

    module = sys.modules["fsmsm_jax.alignment.match"]
    monkeypatch.setattr(module, "fast_match", counted)
    match_room()
    traces.clear()
    other = FastConfig(apart=0.1, box=(0.25, 0.6), stray=1.5, cap=0.4)
    match_room(config=other, pose=NEAR + 0.01)
    match_room(PolygonMap(ROOM.start * 1.01, ROOM.end * 1.01))
    assert not traces
    match_room(config=FastConfig(finish=2))
    assert len(traces) == 1


@pytest.mark.parametrize("method", ["procrustes", "first_principles"])
def test_methods_that_need_every_ray_say_so(method):
    config = FsmsmConfig(orientation=method, memory="pose", **ONE_LEVEL)
    found = match_room(config=config)
    assert off(found.pose, TRUTH)[0] < 5 * NOISE
    half = scan_of(ROOM, TRUTH, Lidar.create(RAYS, np.pi))
    with pytest.raises(ValueError, match="59 of 120 are missing.*'fourier_mellin'"):
        match_room(scan=half, config=config)


def test_a_start_in_a_wall_goes_on_from_beside_it():
    wall = np.array([*(CENTRE + [-2.05, 0.3]), 0.2])  # 5 cm outside
    truth = wall + [0.2, 0.1, 0.1]
    found = match_room(scan=scan_of(ROOM, truth), pose=wall)
    assert bool(found.converged)
    assert off(found.pose, truth)[0] < NOISE


def test_what_cannot_be_matched_is_refused_in_words():
    scan, far = scan_of(ROOM, TRUTH), TRUTH + [100, 0, 0]
    refused = lambda message: pytest.raises(ValueError, match=message)
    with refused("three numbers.*got \\(2,\\)"):
        match_room(pose=TRUTH[:2])
    with refused("starts from finite numbers"):
        match_room(pose=[np.nan, 0, 0])
    with refused("pose 0.*off the map or inside a wall.*0.2 m"):
        match_room(pose=far)
    with refused("at least 8 rays to match, got 7"):
        match(ROOM, scan, NEAR, rays=7)
    with refused("match_batch many"):
        match(ROOM, stack([scan]), NEAR)
    with refused("match_batch takes those"):
        match(stack([ROOM]), scan, NEAR)
    few = Scan.from_ranges([2.0] * 9 + [np.inf] * 111, -np.pi, 2 * np.pi / RAYS)
    with refused("scan 0 has 9 echoes, but it takes at least 10"):
        match_room(scan=few)
    with refused("take many scans, the others one"):
        match_batch(ROOM, scan, NEAR)
    with refused("shape \\(2, 3\\) for 2 scans, got \\(3, 3\\)"):
        match_batch(ROOM, stack([scan, scan]), np.tile(NEAR, (3, 1)))
    with refused("one map or one a scan \\(2\\), got 3"):
        match_batch(stack([ROOM] * 3), stack([scan, scan]), np.tile(NEAR, (2, 1)))
    shorter = Scan(
        scan.ranges, scan.bearings, scan.valid, scan.echo, scan.range_max / 2
    )
    with refused("share one range_max, got 15 to 30 m"):
        match_batch(ROOM, stack([scan, shorter]), np.tile(NEAR, (2, 1)))
    with refused("pose 1"):
        match_batch(ROOM, stack([scan, scan]), np.stack([NEAR, far]))


def test_where_nothing_was_learned_the_estimate_is_given_back():
    """From a limit that no pose can keep, and from a scan of another room."""
    strict = match_room(config=FsmsmConfig(caer_limit=0.001, **ONE_LEVEL))
    elsewhere = match_room(scan=scan_of(star(3), [*CENTRE, 0.2]))
    assert elsewhere.agreement < 0.5
    for found in (strict, elsewhere):
        assert not found.converged
        np.testing.assert_allclose(found.pose, NEAR - [0, 0, 2 * np.pi], atol=1e-5)
        assert found.caer_per_ray == found.caer_before
        sigma = np.sqrt(np.diagonal(np.asarray(found.covariance)))
        np.testing.assert_allclose(sigma * 3**0.5, [0.2, 0.2, np.pi / 4], 1e-3)


dirt = st.sampled_from([np.inf, np.nan, 0.0, -1.0, 1e9, 29.99, 0.01])


@st.composite
def dirty_scans(draw):
    """Some clean rays of the room, the rest dirt, in random directions or in order."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ranges = np.asarray(scan_of(ROOM, TRUTH).ranges, float)
    spoiled = rng.random(RAYS) < draw(st.sampled_from([0.05, 0.5, 0.88, 0.99]))
    ranges[spoiled] = draw(dirt)
    if draw(st.booleans()):
        return ranges, rng.uniform(-10, 10, RAYS)
    return ranges, np.asarray(FULL.bearings)


@given(
    dirty_scans(),
    st.sampled_from(
        [NEAR, TRUTH, [*CENTRE, 1e6], CENTRE.tolist() + [-np.pi], [1e9, 0.0, 0.0],
         [*(CENTRE + [-2.05, 0]), 0.0], [np.nan] * 3, [0, 0, np.inf]]
    ),
)  # fmt: skip
@example((np.zeros(RAYS), np.asarray(FULL.bearings)), NEAR)
@example((np.r_[3.0, np.full(RAYS - 1, np.inf)], np.asarray(FULL.bearings)), NEAR)
@example((np.full(RAYS, 29.0), np.asarray(FULL.bearings)), NEAR)
@settings(max_examples=60)
def test_dirt_ends_in_words_or_in_finite_numbers(scan, pose):
    try:
        found = match_room(scan=Scan.from_bearings(*scan), pose=pose)
    except ValueError:
        return
    for number in found:
        assert np.isfinite(np.asarray(number, float)).all()
    assert -np.pi <= found.pose[2] < np.pi
    reach = 1.31 * 0.2  # the box and what may be strayed
    inside = (np.abs(np.asarray(found.pose)[:2] - np.asarray(pose)[:2]) < reach).all()
    assert inside or not found.converged
    assert bool(ROOM.contains(found.pose[:2])) or not found.converged


@pytest.mark.parametrize(
    ("name", "world", "degrees", "floor"),
    [
        ("mac_turtlebot4_take2", "mac_1st_floor_9_23", 45, 0.95),
        pytest.param("intel", "intel", 45, 0.9, marks=pytest.mark.slow),
        pytest.param("freiburg-079", "freiburg-079", 45, 0.8, marks=pytest.mark.slow),
    ],
)
def test_finds_recorded_poses(data, name, world, degrees, floor):
    """A third of the rays without echo, or half a circle, on maps of other scans."""
    folder = data / "real"
    log = read_scans(folder / f"{name}.npz")
    with np.load(folder / f"{name}.npz") as recorded:
        reference = recorded.get("poses", recorded.get("pseudo_gt_laser_9_23"))
        usable = ~recorded.get("in_map", np.zeros(len(log), bool))
    some = np.flatnonzero(usable)[:: int(usable.sum() / 31.5)][:32]
    truth = np.asarray(reference[some], float)
    scans = stack([log.scan(int(i)) for i in some])
    starts = around(truth, turn=np.deg2rad(degrees))
    found = match_batch(fj.load_map(folder / f"{world}.yaml"), scans, starts)
    metres, angle = off(found.pose, truth)
    right = (metres < 0.1) & (angle < 2)
    assert right.mean() >= floor
    believed = np.asarray(found.converged)
    assert right[believed].mean() >= max(floor, 0.8)
    assert np.median(metres[believed]) < 0.05
    assert np.median(angle[believed]) < 0.8
