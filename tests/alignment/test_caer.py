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
