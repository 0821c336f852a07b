import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fsmsm_jax.alignment.position import (
    masked_position_correction,
    position_correction,
    translate,
)
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import PolygonMap
from tests.oracles import alignment as oracle
from tests.worlds import CENTRE, l_room, square_room, star

RAYS = 120
BEARINGS = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
FULL = np.ones(RAYS, bool)
AHEAD = np.abs(BEARINGS) <= np.pi / 2

plain = jax.jit(position_correction)
masked = jax.jit(masked_position_correction)
cast = jax.jit(raycast)
walk = jax.jit(translate, static_argnums=3)


def scans(seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(2, 9, (2, RAYS)).astype(np.float32)


def convex_room(seed):
    """A random convex outline, its corners on an ellipse of 6 m × 5 m; off the origin."""
    rng = np.random.default_rng(seed)
    angles = np.sort(2 * np.pi * (np.arange(9) + rng.uniform(0, 0.9, 9)) / 9)
    corners = np.stack([6 * np.cos(angles), 5 * np.sin(angles)], axis=-1)
    return PolygonMap.from_outlines(corners + CENTRE)


def see(world, pose, rays=RAYS):
    bearings = jnp.linspace(-jnp.pi, jnp.pi, rays, endpoint=False)
    return cast(world, pose, bearings)


@pytest.mark.parametrize("theta", [0.0, 2.1, -3.0])
def test_the_law_is_half_the_least_squares_step(theta):
    r, v = scans()
    expected = oracle.position_step(r, FULL, v, theta)
    np.testing.assert_allclose(plain(r, v, theta), expected, atol=2e-6)
    for mask in (FULL, AHEAD, np.arange(RAYS) % 7 < 3):
        expected = oracle.position_step(r, mask, v, theta)
        np.testing.assert_allclose(masked(r, mask, v, theta), expected, atol=2e-5)


def test_the_printed_control_vector():
    """u = (1/N)[[c, s], [s, −c]] (Re X1, Im X1), eq. 4.30 and erratum E9."""
    (r, v), theta = scans(1), 0.8
    X1 = oracle.first_harmonic(r.astype(float) - v)
    c, s = np.cos(theta), np.sin(theta)
    u = np.array([[c, s], [s, -c]]) @ [X1.real, X1.imag] / RAYS
    np.testing.assert_allclose(plain(r, v, theta), u, atol=2e-6)


def test_the_step_turns_with_the_heading_and_with_the_rays():
    r, v = scans()
    turn = 2 * np.pi / RAYS * 17
    c, s = np.cos(turn), np.sin(turn)
    for law in (plain, lambda r, v, theta: masked(r, AHEAD, v, theta)):
        step, turned = law(r, v, 0.4), law(r, v, 0.4 + turn)
        np.testing.assert_allclose(
            turned, np.array([[c, -s], [s, c]]) @ step, atol=1e-5
        )
    rolled = plain(np.roll(r, -17), np.roll(v, -17), 0.4 + turn)
    np.testing.assert_allclose(rolled, plain(r, v, 0.4), atol=1e-5)


@given(st.integers(0, 2**31), st.integers(0, 6), st.integers(0, RAYS - 1))
@settings(max_examples=40)
def test_a_mask_of_few_rays_keeps_the_step_bounded(seed, count, first):
    r, v = scans(seed)
    mask = np.roll(np.arange(RAYS) < count, first)
    step = np.asarray(masked(r, mask, v, 0.3))
    longest = np.max(np.abs(v - r), where=mask, initial=0)
    assert np.isfinite(step).all()
    assert np.hypot(*step) <= 10 * longest + 1e-5
    if count == 1:
        assert np.hypot(*step) > 0


def test_invalid_rays_have_no_say():
    r, v = scans()
    garbage = np.where(AHEAD, v, 1e6).astype(np.float32)
    np.testing.assert_array_equal(
        masked(r, AHEAD, garbage, 0.3), masked(r, AHEAD, v, 0.3)
    )


def test_a_circle_is_approached_by_half_the_distance_each_time():
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    circle = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    world = PolygonMap.from_outlines(circle + CENTRE)
    true = jnp.asarray([*CENTRE, 0.9], float)
    ranges = see(world, true)
    pose, error = true + jnp.array([0.06, -0.08, 0.0]), [0.1]
    for _ in range(4):
        pose = walk(world, ranges, pose, 1).pose
        error.append(float(jnp.linalg.norm(pose[:2] - true[:2])))
    np.testing.assert_allclose(np.divide(error[1:], error[:-1]), 0.5, atol=0.01)


def test_theorem_1_the_true_position_is_reached_from_four_metres_away():
    """As in the thesis's figure, from (4, −4) to (0.83, −0.98), in any convex room."""
    offset = np.array([4.0, -4.0]) - [0.83, -0.98]
    for seed in range(4):
        world = convex_room(seed)
        angle = 2.0 * seed
        turn = np.array(
            [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        )
        true = jnp.asarray([*(CENTRE - turn @ offset / 2), angle], float)
        start = true.at[:2].add(jnp.asarray(turn @ offset, float))
        found = walk(world, see(world, true, 360), start, 60)
        assert float(jnp.linalg.norm(found.pose[:2] - true[:2])) < 1e-5
        assert float(found.pose[2]) == float(true[2])
        assert float(found.caers[0]) > 100 * float(found.caers[-1])


def test_around_corners_it_arrives_too_or_its_caer_tells():
    """A jump in depth can balance the step near the truth; CAER sees it."""
    world = star(1)
    rng = np.random.default_rng(0)
    true = np.column_stack(
        [CENTRE + rng.uniform(-0.6, 0.6, (40, 2)), np.linspace(-3, 3, 40)]
    )
    start = true.copy()
    start[:, :2] = CENTRE + rng.uniform(-0.6, 0.6, (40, 2))
    true, start = jnp.asarray(true, float), jnp.asarray(start, float)
    batch = jax.jit(jax.vmap(lambda t, s: translate(world, see(world, t), s, 50)))
    found = batch(true, start)
    error = np.asarray(jnp.linalg.norm(found.pose[:, :2] - true[:, :2], axis=1))
    arrived = error < 1e-5
    assert arrived.mean() >= 0.8
    assert (np.asarray(found.caers[:, -1])[arrived] < 0.1).all()
    assert (np.asarray(found.caers[:, -1])[~arrived] > 0.5).all()


def test_half_a_scan_finds_the_position_too():
    world, true = l_room(), jnp.asarray([*(CENTRE + [0.5, 0.2]), 0.6], float)
    ranges = jnp.where(AHEAD, see(world, true), 30.0)
    start = true + jnp.array([0.2, -0.15, 0.0])
    found = walk(world, ranges, start, 60, jnp.asarray(AHEAD))
    np.testing.assert_allclose(found.pose, true, atol=1e-4)
    blind = walk(world, ranges, start, 60)
    assert float(jnp.linalg.norm(blind.pose - true)) > 0.5


def test_moving_the_world_moves_the_answer():
    world, true = star(2), jnp.asarray([*CENTRE, 0.6], float)
    shift = jnp.array([-8.0, 20.0, 0.0])
    moved = jax.tree.map(lambda ends: ends + shift[None, :2], world)
    start, ranges = true + jnp.array([0.1, 0.1, 0.0]), see(world, true)
    here = walk(world, ranges, start, 3).pose
    there = walk(moved, ranges, start + shift, 3).pose
    np.testing.assert_allclose(there - shift, here, atol=1e-4)


def test_a_gate_shuts_out_a_person_and_an_infinite_one_nobody():
    world, true = square_room(6.0), jnp.asarray([*CENTRE, 0.6], float)
    ranges = see(world, true).at[10:20].set(0.5)
    start = true + jnp.array([0.05, -0.05, 0.0])
    gated = walk(world, ranges, start, 20, None, jnp.asarray(0.25))
    ungated = walk(world, ranges, start, 20, None, jnp.asarray(jnp.inf))
    assert float(jnp.linalg.norm(gated.pose - true)) < 0.02
    assert float(jnp.linalg.norm(ungated.pose - true)) > 0.2
    assert float(gated.caers[-1]) > 20  # the person's rays still count in CAER


def test_least_is_the_best_of_the_poses_scanned():
    world, true = l_room(), jnp.asarray([*CENTRE, 0.6], float)
    ranges = see(world, true)
    start = true + jnp.array([0.3, 0.2, 0.5])  # a wrong heading drives it away
    found = walk(world, ranges, start, 6)
    starts = [start]
    for _ in range(5):
        starts.append(walk(world, ranges, starts[-1], 1).pose)
    caers = [float(jnp.abs(ranges - see(world, s)).sum()) for s in starts]
    np.testing.assert_allclose(found.caers, caers, rtol=1e-4)
    np.testing.assert_allclose(found.least, starts[int(np.argmin(caers))], atol=1e-5)


def test_jit_is_eager_and_vmap_is_the_loop():
    world, true = l_room(), jnp.asarray([*CENTRE, 0.6], float)
    ranges, mask = see(world, true), jnp.asarray(AHEAD)
    starts = true[None, :] + jnp.array([[0.1, 0, 0], [0, -0.2, 0.1]])
    batch = jax.jit(jax.vmap(lambda s: translate(world, ranges, s, 3, mask)))(starts)
    for i, start in enumerate(starts):
        eager = translate(world, ranges, start, 3, mask)
        for a, b in zip(eager, batch, strict=True):
            np.testing.assert_allclose(b[i], a, atol=1e-4, rtol=1e-5)


def test_dtypes_are_kept_under_x64():
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            world = jax.tree.map(lambda a, d=dtype: jnp.asarray(a, d), square_room())
            pose = jnp.asarray([*CENTRE, 0.6], dtype)
            r, mask = jnp.ones(RAYS, dtype), jnp.asarray(AHEAD)
            steps = lambda w, r, m, pose: (
                position_correction(r, r, pose[2]),
                masked_position_correction(r, m, r, pose[2]),
                translate(w, r, pose, 2),
                translate(w, r, pose, 2, m),
            )
            shapes = jax.eval_shape(steps, world, r, mask, pose)
            kinds = {leaf.dtype for leaf in jax.tree.leaves(shapes)}
            assert kinds == {np.dtype(dtype), np.dtype(bool)}  # bool: `stayed`
