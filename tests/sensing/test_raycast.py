import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from fsmsm_jax import geometry
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap
from fsmsm_jax.world.ros_map import load_map
from tests.oracles.raycast import cast_grid, cast_walls
from tests.worlds import (
    CENTRE,
    free_poses,
    l_room,
    random_grid,
    rasterised_room,
    square_room,
    star,
)

BEARINGS = jnp.linspace(-np.pi, np.pi, 180, endpoint=False)
POSE = jnp.array([*(CENTRE + [0.6, -0.4]), 0.7])

cast = jax.jit(raycast)
by_pose = jax.jit(jax.jacfwd(raycast, 1))

# Rounding in float32, in cells: positions of some hundred cells and some hundred
# cells of range times an ulp of the heading give 1e-4; ten times that is allowed.
ROUNDING = 2e-3


@functools.partial(jax.jit, static_argnums=3)
def one_ray_each(world, poses, bearings, limit):
    return jax.vmap(lambda p, b: raycast(world, p, b[None], limit)[0])(poses, bearings)


def check_against_cells(grid, stops, rays, seed, limit=30.0):
    """Every ray agrees with the exact traversal, or with a ray a rounding beside it."""
    rng = np.random.default_rng(seed)
    poses = free_poses(grid, rays, seed).astype(np.float32)
    bearings = rng.uniform(-np.pi, np.pi, rays).astype(np.float32)
    ours = np.asarray(one_ray_each(grid, poses, bearings, limit), float)
    resolution = float(grid.resolution)
    oracle = functools.partial(cast_grid, stops, resolution, np.asarray(grid.origin))
    poses, bearings = poses.astype(float), bearings.astype(float)
    error = np.abs(ours - oracle(poses, bearings, limit)) / resolution
    assert np.median(error) < 0.01
    (odd,) = np.nonzero(error > 0.1)
    assert odd.size < 1e-3 * rays + 3
    beside = [
        oracle(poses[odd], bearings[odd], limit, aside=aside)
        for aside in (-ROUNDING, ROUNDING)
    ]
    missed = np.abs(ours[odd] - beside).min(axis=0) > 0.1 * resolution
    assert not missed.any(), f"{missed.sum()} of {rays} rays: {odd[missed][:5]}"


@pytest.mark.parametrize("unknown", ["transparent", "opaque"])
@pytest.mark.parametrize("seed", range(4))
def test_grid_agrees_with_exact_traversal(seed, unknown):
    grid = random_grid(seed, unknown=unknown)
    cells = np.asarray(grid.cells)
    stops = (cells >= 50) | ((cells < 0) & (unknown == "opaque"))
    assert (cells < 0).any()
    check_against_cells(grid, stops, 20_000, seed)


@pytest.mark.slow
def test_no_wall_is_missed_by_a_million_rays_over_ten_maps():
    for seed in range(10):
        grid = random_grid(seed, 400, 600)
        check_against_cells(grid, np.asarray(grid.occupied), 100_000, seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "gl/basement_5cm",
        "gl/cbgl_willow",
        "gl/cbgl_warehouse",
        "real/intel",
        "real/freiburg-079",
        "real/csail",
        "real/mac_1st_floor_9_23",
        "maps/nav2__testmap",
        "maps/f1tenth_sim__stata_basement",
        "maps/turtlebot_apps__willow-2010-02-18-0.10",
    ],
)
def test_no_wall_of_a_real_map_is_missed(data, name):
    grid = load_map(data / f"{name}.yaml")
    check_against_cells(grid, np.asarray(grid.occupied), 100_000, 7)


@pytest.mark.parametrize("world", [l_room(), *map(star, range(3))])
def test_polygons_agree_with_exact_intersection(world):
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    for turn in (0.0, 2.0):
        pose = POSE.at[2].add(turn)
        x, y, theta = np.asarray(pose, float)
        headings = theta + np.asarray(BEARINGS, float)
        exact = cast_walls(start, end, np.array([x, y]), headings, 30.0)
        error = np.abs(cast(world, pose, BEARINGS) - exact)
        # Walls seen edge-on magnify rounding, and a corner may fall to either side.
        assert np.median(error) < 1e-5
        assert np.mean(error > 1e-3) < 0.02


def test_polygons_have_no_gaps_between_walls():
    rng = np.random.default_rng(0)
    turns = rng.uniform(-np.pi, np.pi, 2000).astype(np.float32)
    for world in (square_room(), star(4, corners=40)):
        corners = np.asarray(world.start - POSE[None, :2], float)
        at_corners = np.arctan2(corners[:, 1], corners[:, 0]) - float(POSE[2])
        bearings = jnp.asarray(np.concatenate([turns, at_corners]), jnp.float32)
        assert cast(world, POSE, bearings, 50.0).max() < 50


@pytest.mark.parametrize("seed", range(2))
def test_veils_hide_what_is_behind_them(seed):
    """Against one ray at a time: of all the walls and veils, what comes first?

    A veil stops who comes from its left, where the space is that was seen, and lets in
    who comes from its right.
    """
    room = star(seed, corners=40)
    solid = np.random.default_rng(seed).uniform(size=40) < 0.7
    world = PolygonMap(room.start, room.end, jnp.asarray(solid))
    start, end = np.asarray(room.start, float), np.asarray(room.end, float)
    for pose in (POSE, POSE + jnp.array([7.0, 2.0, 0.0])):  # in the room, and without
        position, headings = np.asarray(pose[:2], float), np.asarray(pose[2] + BEARINGS)
        a, b = start - position, end - position
        left = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
        met = solid | left
        ranges = cast_walls(start[met], end[met], position, headings, 30.0)
        walls = cast_walls(start[solid], end[solid], position, headings, 30.0)
        expected = np.where(np.isclose(ranges, walls), walls, 30.0)
        assert 0.02 < np.mean(expected < 30) < 0.98
        found = np.asarray(cast(world, pose, BEARINGS))
        assert np.mean(np.abs(found - expected) > 1e-3) < 0.02  # corners, as above
        derivative = np.asarray(by_pose(world, pose, BEARINGS))
        np.testing.assert_array_equal(derivative[found == 30], 0)


def test_yaw_of_the_origin_turns_the_map():
    cells = np.pad(np.asarray(random_grid(5).cells), 1, constant_values=100)
    flat = OccupancyGrid.from_cells(cells, 0.05, (3.0, -8.0, 0.0))
    move = jnp.array([10.0, 20.0, 1.0])
    turned = OccupancyGrid.from_cells(cells, 0.05, geometry.compose(move, flat.origin))
    pose = jnp.asarray(free_poses(flat, 1, seed=1)[0], jnp.float32)
    there = geometry.compose(move, pose)
    ranges = cast(flat, pose, BEARINGS)
    assert ranges.max() < 30
    error = np.abs(cast(turned, there, BEARINGS) - ranges)
    assert np.median(error) < 1e-4
    assert np.mean(error > 0.005) < 0.02  # corners of cells
    # Without its yaw the map is another one.
    straight = OccupancyGrid.from_cells(
        cells, 0.05, (*np.asarray(turned.origin[:2]), 0)
    )
    assert np.mean(np.abs(cast(straight, there, BEARINGS) - ranges) > 0.1) > 0.5


def test_unknown_space_stops_rays_or_lets_them_through():
    cells = np.zeros((20, 40), int)
    cells[:, 20:24] = -1
    cells[:, 30:] = 100
    ahead = jnp.zeros(1)
    pose = jnp.array([11.0, -9.0, 0.0])
    for unknown, expected in (("transparent", 2.0), ("opaque", 1.0)):
        grid = OccupancyGrid.from_cells(cells, 0.1, (10.0, -10.0, 0.0), unknown=unknown)
        np.testing.assert_allclose(cast(grid, pose, ahead), expected, rtol=1e-5)


@pytest.mark.parametrize("away", [1e-3, 3.0, 1e4])
@pytest.mark.parametrize("side", range(4))
def test_outside_a_grid_nothing_is_seen(away, side):
    grid = OccupancyGrid.from_cells(np.full((20, 30), 100), 0.1, (10.0, -10.0, 0.0))
    x = [10 - away, 13 + away, 11.5, 11.5][side]
    y = [-9, -9, -10 - away, -8 + away][side]
    ranges = cast(grid, jnp.array([x, y, 0.3]), BEARINGS, 25.0)
    np.testing.assert_array_equal(ranges, 25.0)


def test_a_ray_that_leaves_the_grid_reads_range_max():
    cells = np.zeros((20, 30), int)
    cells[:, 25] = 100
    grid = OccupancyGrid.from_cells(cells, 0.1, (10.0, -10.0, 0.0))
    pose = jnp.array([11.0, -9.0, 0.0])
    bearings = jnp.array([0.0, np.pi / 2, np.pi, -np.pi / 2])
    expected = [1.5, 25.0, 25.0, 25.0]
    np.testing.assert_allclose(cast(grid, pose, bearings, 25.0), expected, rtol=1e-5)


@pytest.mark.parametrize("world", [random_grid(1), star(1)])
def test_ranges_are_capped(world):
    grid = isinstance(world, OccupancyGrid)
    pose = jnp.asarray(free_poses(world, 1)[0], jnp.float32) if grid else POSE
    full = cast(world, pose, BEARINGS, 30.0)
    cap = float(np.median(full))
    capped = cast(world, pose, BEARINGS, cap)
    np.testing.assert_array_equal(capped[full >= cap], cap)
    np.testing.assert_allclose(capped, np.minimum(full, cap), rtol=1e-6, atol=1e-5)
    assert capped.min() < cap


def test_inside_an_obstacle_everything_is_at_zero():
    grid = random_grid(2)
    row, column = np.argwhere(np.asarray(grid.occupied))[5]
    x, y = grid.to_map(jnp.array([column + 0.3, row + 0.6]))
    ranges = cast(grid, jnp.array([x, y, 0.0]), BEARINGS)
    np.testing.assert_array_equal(ranges, 0.0)


def test_poses_that_are_not_finite_come_back():
    for bad in (np.nan, np.inf):
        ranges = cast(random_grid(1), jnp.array([bad, 0.0, 0.0]), BEARINGS)
        assert ranges.shape == BEARINGS.shape  # and no endless loop


# ---- JAX ---------------------------------------------------------------------------


def case(kind):
    if kind == "grid":
        worlds = [random_grid(1), random_grid(2)]
        poses = free_poses(worlds[0], 6)
    else:
        worlds = [star(1), star(2)]
        poses = np.asarray(POSE)[None] + 0.1 * np.random.default_rng(0).normal(
            size=(6, 3)
        )
    return worlds, jnp.asarray(poses, jnp.float32)


def assert_same_ranges(ranges, expected):
    """Equal up to float32, except where fusion rounds a ray past a corner."""
    error = np.abs(np.asarray(ranges) - np.asarray(expected))
    assert np.mean(error > 1e-4) <= 1e-3, error.max()


@pytest.mark.parametrize("kind", ["grid", "polygons"])
def test_vmap_is_a_loop_and_jit_is_eager(kind):
    worlds, poses = case(kind)
    world = worlds[0]
    loop = np.stack([cast(world, pose, BEARINGS) for pose in poses])
    assert_same_ranges(raycast(world, poses[0], BEARINGS), loop[0])
    batch = jax.vmap(raycast, (None, 0, None))
    assert_same_ranges(jax.jit(batch)(world, poses, BEARINGS), loop)

    nested = jax.jit(jax.vmap(batch, (None, 0, None)))
    nested = nested(world, poses.reshape(2, 3, 3), BEARINGS)
    assert_same_ranges(nested.reshape(6, -1), loop)

    turned = BEARINGS[None] + jnp.arange(6.0)[:, None]
    over_bearings = jax.jit(jax.vmap(raycast, (None, None, 0)))
    over_bearings = over_bearings(world, poses[0], turned)
    assert_same_ranges(over_bearings[4], cast(world, poses[0], turned[4]))

    limits = jnp.array([1.0, 2.0, 30.0])
    over_limits = jax.jit(jax.vmap(raycast, (None, None, None, 0)))
    capped = over_limits(world, poses[0], BEARINGS, limits)
    assert_same_ranges(capped, np.minimum(loop[0], np.asarray(limits)[:, None]))


@pytest.mark.parametrize("kind", ["grid", "polygons"])
def test_vmap_over_worlds(kind):
    worlds, poses = case(kind)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    pairs = jax.jit(jax.vmap(raycast, (0, 0, None)))(both, poses[:2], BEARINGS)
    for i, world in enumerate(worlds):
        assert_same_ranges(pairs[i], cast(world, poses[i], BEARINGS))
    many = jax.jit(jax.vmap(jax.vmap(raycast, (None, 0, None)), (0, None, None)))
    ranges = many(both, poses, BEARINGS)
    assert ranges.shape == (2, 6, len(BEARINGS))
    assert_same_ranges(ranges[1, 3], cast(worlds[1], poses[3], BEARINGS))


@pytest.mark.parametrize("rays", [1, 2047, 2048, 2049, 5000])
def test_compaction_changes_nothing(rays):
    """Long batches are walked in shrinking blocks; short ones are not."""
    grid = random_grid(3)
    rng = np.random.default_rng(3)
    pose = jnp.asarray(free_poses(grid, 1)[0], jnp.float32)
    bearings = jnp.asarray(rng.uniform(-np.pi, np.pi, rays), jnp.float32)
    pieces = [cast(grid, pose, bearings[i : i + 500]) for i in range(0, rays, 500)]
    assert_same_ranges(cast(grid, pose, bearings), np.concatenate(pieces))


def test_batches_longer_than_a_chunk():
    grid = random_grid(3)
    poses = jnp.asarray(free_poses(grid, 900), jnp.float32)
    bearings = jnp.asarray(np.linspace(-3, 3, 300), jnp.float32)  # 270 000 rays > 2¹⁸
    batch = jax.jit(jax.vmap(raycast, (None, 0, None)))
    whole = batch(grid, poses, bearings)
    parts = [batch(grid, poses[i : i + 300], bearings) for i in (0, 300, 600)]
    assert_same_ranges(whole, np.concatenate(parts))


@pytest.mark.parametrize("kind", ["grid", "polygons"])
def test_float64_is_near_float32(kind):
    worlds, poses = case(kind)
    small = cast(worlds[0], poses[0], BEARINGS)
    with jax.enable_x64(True):
        world = case(kind)[0][0]
        pose, bearings = jnp.asarray(poses[0], float), jnp.asarray(BEARINGS, float)
        exact = cast(world, pose, bearings)
        gradient = by_pose(world, pose, bearings)
        assert exact.dtype == gradient.dtype == jnp.float64
    error = np.abs(np.asarray(exact) - np.asarray(small))
    assert np.median(error) < 1e-5
    assert np.mean(error > 1e-3) < 0.02


# ---- derivative --------------------------------------------------------------------


def differences(world, pose, bearings, step):
    """Central differences of the ranges by the pose, (rays, 3)."""
    columns = [
        (cast(world, pose + d, bearings) - cast(world, pose - d, bearings)) / (2 * step)
        for d in step * jnp.eye(3, dtype=pose.dtype)
    ]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("make", [square_room, l_room, lambda: star(5)])
def test_derivative_on_polygons_is_exact(make):
    with jax.enable_x64(True):
        world = make()
        pose, bearings = jnp.asarray(POSE, float), jnp.asarray(BEARINGS, float)
        jacobian = np.asarray(by_pose(world, pose, bearings))
        numeric = differences(world, pose, bearings, 1e-6)
    # A step of 1e-6 m crosses no corner here, and jumps nowhere; rays within 6° of
    # a wall are capped by design: their derivative exceeds 1/0.1 in x or y.
    steep = np.hypot(numeric[:, 0], numeric[:, 1]) > 9.9
    assert steep.mean() < 0.1
    np.testing.assert_allclose(jacobian[~steep], numeric[~steep], rtol=1e-6, atol=1e-6)
    assert np.hypot(*jacobian[steep, :2].T).max(initial=0) <= 10 + 1e-9


def test_derivative_has_the_closed_form_of_a_wall():
    """Of the wall x = c: r = (c − x) / cos(θ + φ)."""
    room = square_room(4.0)
    bearings = jnp.linspace(-0.4, 0.4, 9)
    pose = jnp.array([*(CENTRE + [0.5, 0.1]), 0.2])
    heading = np.asarray(pose[2] + bearings)
    ranges = (CENTRE[0] + 2 - pose[0]) / np.cos(heading)
    np.testing.assert_allclose(cast(room, pose, bearings), ranges, rtol=1e-5)
    d_pose, d_bearing = jax.jit(jax.jacfwd(raycast, (1, 2)))(room, pose, bearings)
    turn = ranges * np.tan(heading)
    expected = np.stack([-1 / np.cos(heading), np.zeros(9), turn], axis=-1)
    np.testing.assert_allclose(d_pose, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(d_bearing, np.diag(turn), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("yaw", [0.0, 0.3, 0.7])
def test_derivative_on_grids_is_the_walls_and_not_the_cells(yaw):
    """A slanted wall painted in cells is differentiated as the wall it depicts."""
    grid, room = rasterised_room(yaw)
    # The middle of the room, on purpose some way off centre.
    middle = np.asarray(room.start, float).mean(axis=0)
    angles = []
    for dx, dy, theta in [(0.3, -0.8, 0.1), (-1.1, 0.6, 2.0), (1.7, 1.2, -2.5)]:
        pose = jnp.array([middle[0] + dx, middle[1] + dy, theta], jnp.float32)
        painted, exact = (np.asarray(by_pose(w, pose, BEARINGS)) for w in (grid, room))
        cross = painted[:, 0] * exact[:, 1] - painted[:, 1] * exact[:, 0]
        dot = np.sum(painted[:, :2] * exact[:, :2], axis=1)
        angles.append(np.abs(np.rad2deg(np.arctan2(cross, dot))))
    # Faces of cells would be off by the yaw itself, 17° and 40°; the blur of 1.5 cells
    # leaves 2° and 4° (measured), for stairs longer than it shows through.
    assert np.median(np.concatenate(angles)) < 5
    assert np.quantile(np.concatenate(angles), 0.8) < 8


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_derivative_on_grids_agrees_with_differences_over_some_cells(yaw):
    grid, _ = rasterised_room(yaw)
    pose = jnp.asarray([*np.asarray(grid.to_map(jnp.full(2, 130.0))), 0.1], jnp.float32)
    jacobian = np.asarray(by_pose(grid, pose, BEARINGS))
    # Stairs of one cell over a step of eight: differences are off by up to 1/8 each.
    numeric = differences(grid, pose, BEARINGS, 0.2)[:, :2]
    error = np.abs(jacobian[:, :2] - numeric).max(axis=1)
    assert np.median(error / np.abs(numeric).max(axis=1)) < 0.125


@pytest.mark.parametrize("kind", ["grid", "polygons"])
def test_forward_and_reverse_mode_agree(kind):
    worlds, poses = case(kind)
    scan = functools.partial(raycast, worlds[0], bearings=BEARINGS)
    forward = jax.jit(jax.jacfwd(scan))(poses[0])
    reverse = jax.jit(jax.jacrev(scan))(poses[0])
    np.testing.assert_allclose(forward, reverse, rtol=1e-5, atol=1e-5)
    batched = jax.jit(jax.vmap(jax.jacfwd(scan)))(poses)
    np.testing.assert_allclose(batched[0], forward, rtol=1e-4, atol=1e-4)
    loss = jax.jit(jax.grad(lambda pose: jnp.sum((scan(pose) - 2.0) ** 2)))
    expected = 2 * (scan(poses[0]) - 2.0) @ forward
    np.testing.assert_allclose(loss(poses[0]), expected, rtol=1e-3)


def test_derivative_is_zero_where_nothing_is_hit():
    grid = OccupancyGrid.from_cells(np.zeros((20, 30), int), 0.1, (10.0, -10.0, 0.3))
    triangle = PolygonMap.from_outlines([[50.0, 50], [51, 50], [50, 51]])
    inside = jnp.array([10.5, -9.0, 0.2])
    for world, pose, limit in [
        (grid, inside, 30.0),  # leaves the map
        (grid, jnp.array([-70.0, 30.0, 0.2]), 30.0),  # outside
        (triangle, jnp.array([10.0, 10.0, 0.2]), 5.0),  # too far away
        (random_grid(1), inside, 1e-3),
    ]:
        jacobian = by_pose(world, pose, BEARINGS, limit)
        np.testing.assert_array_equal(jacobian, 0.0)


def test_derivative_is_finite_and_bounded_at_the_kinks():
    room = square_room(4.0)
    corner = jnp.asarray([*(CENTRE + [1.0, 1.0]), np.pi / 4], jnp.float32)
    along_wall = jnp.asarray([*(CENTRE + [-1.9, 2 - 1e-4]), 0.0], jnp.float32)
    on_wall = jnp.asarray([*(CENTRE + [0.0, 2.0]), 0.0], jnp.float32)
    bearings = jnp.array([0.0, 1e-7, -1e-7, 1e-3, np.pi / 2, np.pi, -np.pi / 2, 2.0])
    grid = random_grid(1)
    inside_obstacle = np.argwhere(np.asarray(grid.occupied))[5][::-1] + 0.5
    x, y = grid.to_map(jnp.asarray(inside_obstacle, jnp.float32))
    for world, pose in [
        (room, corner),
        (room, along_wall),
        (room, on_wall),
        (grid, jnp.array([x, y, 0.0])),
        (grid, jnp.array([*grid.to_map(jnp.array([30.0, 40.0])), -grid.origin[2]])),
    ]:
        ranges = cast(world, pose, bearings)
        jacobian = by_pose(world, pose, bearings)
        assert np.isfinite(ranges).all()
        assert np.isfinite(jacobian).all()
        assert np.abs(jacobian[:, :2]).max() <= 10 + 1e-4
        assert (np.abs(jacobian[:, 2]) <= 10 * ranges + 1e-4).all()


# ---- symmetry ----------------------------------------------------------------------

moves = st.tuples(
    st.floats(-64, 64, width=32), st.floats(-64, 64, width=32), st.floats(-4, 4)
).map(lambda m: jnp.array(m, jnp.float32))


@given(moves)
def test_moving_a_polygon_world_and_the_sensor_changes_nothing(move):
    for world, share in ((square_room(), 0.0), (l_room(), 0.02), (star(6), 0.05)):
        moved = PolygonMap(
            start=geometry.transform_points(move, world.start),
            end=geometry.transform_points(move, world.end),
        )
        there = geometry.compose(move, POSE)
        error = np.abs(cast(moved, there, BEARINGS) - cast(world, POSE, BEARINGS))
        # Coordinates of 100 m have ulps of 8e-6 m; the rest are rays past a corner.
        assert np.mean(error > 2e-3) <= share


@given(moves, st.integers(0, 5))
def test_moving_a_grid_and_the_sensor_changes_nothing(move, which):
    grid = random_grid(1)
    pose = jnp.asarray(free_poses(grid, 6)[which], jnp.float32)
    origin = geometry.compose(move, grid.origin)
    moved = OccupancyGrid(
        cells=grid.cells,
        resolution=grid.resolution,
        origin=origin,
        clearance=grid.clearance,
        distance=grid.distance,
        slope=grid.slope,
    )
    there = geometry.compose(move, pose)
    error = np.abs(cast(moved, there, BEARINGS) - cast(grid, pose, BEARINGS))
    assert np.median(error) < 1e-3
    assert np.mean(error > 0.005) < 0.05


@given(st.integers(1, 179))
def test_turning_the_sensor_rolls_the_scan(rays):
    world = l_room()
    step = np.float32(2 * np.pi / len(BEARINGS))
    turned = POSE.at[2].add(rays * step)
    error = np.abs(
        cast(world, turned, BEARINGS) - jnp.roll(cast(world, POSE, BEARINGS), -rays)
    )
    assert np.mean(error > 1e-3) <= 0.02


def test_no_trace_per_call():
    traces = []

    @jax.jit
    def traced(world, pose):
        traces.append(1)
        return cast(world, pose, BEARINGS)

    for seed in (1, 2):
        grid = random_grid(seed)
        for pose in jnp.asarray(free_poses(grid, 3), jnp.float32):
            traced(grid, pose)
    assert len(traces) == 1


def test_cap_is_kept_to_the_last_bit():
    cells = np.zeros((40, 400), int)
    cells[:, 350:] = 100
    grid = OccupancyGrid.from_cells(cells, 0.05, (10.0, -10.0, 0.0))
    x = jnp.linspace(10.2, 10.25, 500)
    poses = jnp.stack([x, jnp.full(500, -9.0), jnp.zeros(500)], axis=-1)
    ahead = jnp.zeros(1)
    batch = jax.jit(jax.vmap(raycast, (None, 0, None, None)))
    for limit in (17.3, 17.299, 17.27):
        ranges = batch(grid, poses, ahead, limit)
        assert ranges.max() <= np.float32(limit)
