import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.caer import (
    caer,
    caer_at,
    caer_per_ray,
    truncated_caer_per_ray,
)
from fsmsm_jax.alignment.kernels import (
    Absolute,
    BeamModel,
    GemanMcClure,
    PseudoHuber,
    Truncated,
)
from fsmsm_jax.sensing import Lidar, Scan, raycast
from tests.oracles import alignment as oracle
from tests.worlds import CENTRE, l_room, rasterised_room, square_room

cast = jax.jit(raycast)  # un-jitted, each operation compiles by itself
cost_at = jax.jit(caer_at)
slope_at = jax.jit(jax.grad(caer_at, argnums=2))

POSE = [*(CENTRE + [0.4, -0.3]), 0.7]


def scans(rays=40):
    rng = np.random.default_rng(1)
    return (
        rng.uniform(1, 9, rays),
        rng.uniform(1, 9, rays),
        rng.uniform(size=rays) < 0.6,
    )


def test_the_three_measures_are_the_loop():
    r, v, mask = scans()
    a, b, m = jnp.asarray(r, float), jnp.asarray(v, float), jnp.asarray(mask)
    full = np.ones(len(r), bool)
    assert float(caer(a, b)) == pytest.approx(oracle.caer(r, v, full), rel=1e-6)
    total = oracle.caer(r, v, mask)
    assert float(caer(a, b, m)) == pytest.approx(total, rel=1e-6)
    assert float(caer_per_ray(a, b, m)) == pytest.approx(total / mask.sum(), rel=1e-6)
    capped = r + np.clip(v - r, -0.5, 0.5)
    expected = oracle.caer(r, capped, mask) / mask.sum()
    assert float(truncated_caer_per_ray(a, b, 0.5, m)) == pytest.approx(expected)


def test_a_scan_that_says_nothing_never_wins():
    nothing = jnp.zeros(3, bool)
    assert float(caer(jnp.ones(3), jnp.zeros(3), nothing)) == 0.0
    for measure in (
        caer_per_ray(jnp.ones(3), jnp.zeros(3), nothing),
        truncated_caer_per_ray(jnp.ones(3), jnp.zeros(3), 0.5, nothing),
    ):
        assert float(measure) == np.inf


def test_the_truth_costs_nothing_at_any_field_of_view():
    room, pose = l_room(), jnp.asarray(POSE, float)
    for field_of_view in (np.pi, 1.5 * np.pi, 2 * np.pi):
        lidar = Lidar.create(90, field_of_view, noise=0.0)
        exact = cast(room, pose, lidar.bearings)
        scan = lidar.measure(jax.random.key(0), exact)
        assert float(cost_at(room, scan, pose)) < 1e-3
        away = pose + jnp.array([0.2, 0.0, 0.0])
        assert float(cost_at(room, scan, away)) > 1.0


def test_no_echo_means_free_as_far_as_the_sensor_sees():
    """In a 4 m square, from its middle: walls at 2 m ahead, left, behind and right."""
    room, pose = square_room(4.0), jnp.asarray([*CENTRE, 0.0], float)

    def cost(ranges, range_max):
        scan = Scan.from_ranges(ranges, 0.0, np.pi / 2, range_max=range_max)
        return float(cost_at(room, scan, pose))

    assert cost([2.0, 2.0, 2.0, 2.0], 8.0) == pytest.approx(0, abs=1e-5)
    assert cost([2.0, np.inf, 2.0, 2.0], 8.0) == pytest.approx(6, abs=1e-5)
    assert cost([1.5, np.inf, np.inf, np.inf], 1.75) == pytest.approx(0.25, abs=1e-5)
    assert cost([2.0, np.nan, 0.0, 3.0], 8.0) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("world", [square_room(), l_room()], ids=["square", "L"])
def test_gradient_is_the_finite_difference(world):
    with jax.enable_x64(True):
        world = jax.tree.map(lambda a: jnp.asarray(a, float), world)
        # Not a round number of rays: no ray meets a corner, where ranges have a kink.
        lidar = Lidar.create(101, 1.5 * np.pi, range_max=4.0)
        truth = jnp.asarray(POSE, float)
        exact = cast(world, truth, lidar.bearings, lidar.range_max)
        scan = lidar.measure(jax.random.key(1), exact)
        pose = truth + jnp.array([0.11, 0.07, -0.05])
        gradient = slope_at(world, scan, pose)
        step = 1e-6 * jnp.eye(3)
        ends = [[cost_at(world, scan, pose + h) for h in (s, -s)] for s in step]
        numeric = [(after - before) / 2e-6 for after, before in ends]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4)


def test_gradient_is_finite_where_scans_agree_and_where_nothing_is_seen():
    grid, outline = rasterised_room(yaw=0.3)
    bearings = jnp.linspace(-np.pi, np.pi, 36, endpoint=False)
    centre = jnp.asarray((outline.start.mean(axis=0)).tolist() + [0.2], float)
    for world in (grid, outline):
        exact = cast(world, centre, bearings)
        seen, unseen = jnp.ones(36, bool), jnp.zeros(36, bool)
        for ranges, valid in ((exact, seen), (exact + 1, seen), (exact, unseen)):
            scan = Scan(ranges, bearings, valid, valid, jnp.asarray(30.0))
            for pose in (centre, centre + 500.0):
                assert bool(jnp.isfinite(slope_at(world, scan, pose)).all())


def test_the_world_and_the_pose_can_move_together_and_be_batched():
    room, pose = l_room(), jnp.asarray(POSE, float)
    lidar = Lidar.create(90, noise=0.05)
    scan = lidar.measure(jax.random.key(2), cast(room, pose, lidar.bearings))
    shift = jnp.array([-5.0, 3.0])
    moved = jax.tree.map(lambda ends: ends + shift[None, :], room)
    there = pose.at[:2].add(shift)
    assert float(cost_at(moved, scan, there)) == pytest.approx(
        float(cost_at(room, scan, pose)), abs=1e-3
    )
    poses = pose[None, :] + jnp.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.1, 1.0]])
    batch = jax.jit(jax.vmap(lambda p: caer_at(room, scan, p)))(poses)
    loop = [float(cost_at(room, scan, p)) for p in poses]
    np.testing.assert_allclose(batch, loop, rtol=1e-5)


def test_dtypes_are_kept_under_x64():
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            measures = lambda a, mask: (
                caer(a, a, mask),
                caer_per_ray(a, a, mask),
                truncated_caer_per_ray(a, a, 0.5, mask),
            )
            shapes = jax.eval_shape(measures, jnp.ones(4, dtype), jnp.ones(4, bool))
            assert {leaf.dtype for leaf in shapes} == {np.dtype(dtype)}


# --- Every form, as an objective ----------------------------------------------------

FORMS = (
    Absolute(),
    PseudoHuber(0.05),
    GemanMcClure(0.5),
    Truncated(0.5),
    BeamModel(0.3),
)
POSES = 10_000


def questions(world, xy, seed):
    """A noisy scan, some rays blocked, lost or without echo, and random poses."""
    rng, rays = np.random.default_rng(seed), 31
    bearings = jnp.asarray(np.linspace(-2.5, 2.5, rays), float)
    exact = np.asarray(cast(world, jnp.asarray([*xy[0], 0.4], float), bearings, 6.0))
    ranges = exact + 0.02 * rng.standard_normal(rays)
    ranges[rng.uniform(size=rays) < 0.1] *= 0.5
    ranges = jnp.asarray(np.minimum(ranges, 6.0), float)
    valid = jnp.asarray(rng.uniform(size=rays) < 0.9)
    scan = Scan(ranges, bearings, valid, valid & (ranges < 6.0), jnp.asarray(6.0))
    headings = rng.uniform(-np.pi, np.pi, (len(xy), 1))
    return scan, jnp.asarray(np.concatenate([xy, headings], axis=1), float)


@jax.jit
def slopes(world, scan, poses, forms):
    """By `jax.grad`, and over the smooth rays both by it and by central differences.

    Not smooth, so that no derivative could be right for both sides, is a ray that

    - changes walls between the two poses (a corner passes, or a wall comes into view);
    - has its e pass a kink of some kernel (0, or the limit of 0.5 m);
    - grazes its wall within 6°: the derivative is capped by design.
    """
    h = 1e-6

    def one(pose):
        look = lambda pose: raycast(world, pose, scan.bearings, scan.range_max)
        ranges, derivative = jax.linearize(look, pose)
        J = jax.vmap(derivative)(jnp.eye(3)).T
        steps = h * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
        virtual = jax.vmap(look)(pose[None] + steps)
        secant = (virtual[:3] - virtual[3:]).T / (2 * h)
        slant = jnp.linalg.norm(J[:, :2], axis=-1)
        unlike = jnp.abs(secant - J) > 1e-3 * (1 + slant[:, None] ** 3)
        e, around = scan.ranges - ranges, scan.ranges[None] - virtual
        side = lambda e: jnp.sign(e) + 3 * (jnp.abs(e) < 0.5)
        kink = jnp.any(side(e)[None] != side(around), axis=0)
        smooth = scan.valid & ~(jnp.any(unlike, axis=1) | kink | (slant > 9.9))

        def three(kernel):
            cost = lambda virtual: caer(scan.ranges, virtual, smooth, kernel)
            ends = jax.vmap(cost)(virtual)
            return (
                jax.grad(caer_at, argnums=2)(world, scan, pose, kernel),
                jax.grad(lambda pose: cost(look(pose)))(pose),
                (ends[:3] - ends[3:]) / (2 * h),
            )

        return [three(kernel) for kernel in forms], smooth

    return jax.lax.map(one, poses, batch_size=500)


def test_gradients_of_ten_thousand_poses_in_a_room_are_finite_differences():
    with jax.enable_x64(True):
        room = jax.tree.map(lambda a: jnp.asarray(a, float), l_room())
        rng = np.random.default_rng(4)
        xy = CENTRE + rng.uniform(0, 1, (POSES, 2)) * [5.8, 2.3] - [1.9, 0.9]
        scan, poses = questions(room, xy, seed=5)
        found, smooth = slopes(room, scan, poses, FORMS)
        kept = float(smooth.sum() / (POSES * scan.valid.sum()))
        assert kept > 0.97  # grazing rays, nearly all of the rest
        for kernel, (whole, gradient, numeric) in zip(FORMS, found, strict=True):
            name = type(kernel).__name__
            assert bool(jnp.isfinite(whole).all()), name
            np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4, err_msg=name)  # fmt: skip
            # Where no ray was an exception, this is the gradient of the whole.
            every = jnp.all(smooth == scan.valid[None], axis=1)
            assert float(every.mean()) > 0.5
            np.testing.assert_allclose(whole[every], numeric[every], rtol=1e-4, atol=1e-4)  # fmt: skip


@jax.jit
def coarse_slopes(world, scan, poses, forms):
    """By `jax.grad`, and by differences over three cells to either side."""
    steps = 0.15 * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]) / jnp.array([[1, 1, 3.0]])

    def one(pose):
        look = lambda pose: raycast(world, pose, scan.bearings, scan.range_max)
        virtual = jax.vmap(look)(pose[None] + steps)

        def two(kernel):
            ends = jax.vmap(lambda v: caer(scan.ranges, v, scan.valid, kernel))(virtual)
            by_grad = jax.grad(caer_at, argnums=2)(world, scan, pose, kernel)
            return by_grad, (ends[:3] - ends[3:]) / (2 * jnp.diagonal(steps[:3]))

        return [two(kernel) for kernel in forms]

    return jax.lax.map(one, poses, batch_size=500)


def test_gradients_of_ten_thousand_poses_on_a_grid_point_the_right_way():
    """On a grid the ranges step from cell to cell and the derivative is that of the
    smoothed wall, so a finite difference means something over some cells only. There
    the kernels bend, and so the two are asked to agree in direction, not in digits."""
    grid, outline = rasterised_room(yaw=0.3)
    middle = np.asarray(outline.start).mean(axis=0)
    xy = middle + np.random.default_rng(6).uniform(-1.3, 1.3, (POSES, 2))
    scan, poses = questions(grid, xy, seed=7)
    found = coarse_slopes(grid, scan, poses, FORMS)
    for kernel, (gradient, numeric) in zip(FORMS, found, strict=True):
        name = type(kernel).__name__
        assert bool(jnp.isfinite(gradient).all()), name
        for a, b in zip(np.asarray(gradient).T, np.asarray(numeric).T, strict=True):
            assert np.corrcoef(a, b)[0, 1] > 0.9, name
        downhill = jnp.sum(gradient * numeric, axis=1) > 0
        assert float(downhill.mean()) > 0.95, name


def test_forward_mode_is_reverse_mode():
    grid, outline = rasterised_room(yaw=0.3)
    centre = np.asarray(outline.start).mean(axis=0)
    pose = jnp.asarray([*(centre + 0.4), 0.2], float)

    @jax.jit
    def all_slopes(world, scan, pose):
        forward = [jax.jacfwd(caer_at, argnums=2)(world, scan, pose, k) for k in FORMS]
        reverse = [jax.grad(caer_at, argnums=2)(world, scan, pose, k) for k in FORMS]
        return jnp.stack(forward), jnp.stack(reverse)

    for world in (grid, outline):
        scan, _ = questions(world, centre[None], seed=8)
        forward, reverse = all_slopes(world, scan, pose)
        np.testing.assert_allclose(forward, reverse, rtol=1e-4, atol=1e-4)


def test_equal_scans_pull_nowhere():
    ranges = jnp.linspace(1, 5, 9)
    for kernel in FORMS:
        slope = jax.grad(caer, argnums=1)(ranges, ranges, None, kernel)
        np.testing.assert_array_equal(slope, 0.0)


def test_the_plain_form_is_the_default_and_robust_ones_cap_the_blocked_ray():
    room, pose = square_room(4.0), jnp.asarray([*CENTRE, 0.0], float)
    scan = Scan.from_ranges([2.0, 0.5, 2.1, 1.9], 0.0, np.pi / 2)
    cost = lambda *kernel: float(cost_at(room, scan, pose, *kernel))
    assert cost() == cost(Absolute()) == pytest.approx(1.7, abs=1e-5)
    assert cost(Truncated(0.3)) == pytest.approx(0.5, abs=1e-5)
    assert 1.4 < cost(PseudoHuber(0.05)) < 1.7
    assert cost(GemanMcClure(0.2)) < 0.2 + 2 * 0.1
    assert cost(BeamModel(0.1, short=0.1, long=0.01)) < 0.1 * np.log(11) + 2 * 0.05
