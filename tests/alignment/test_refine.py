"""`refine`: home from 10 cm and 5°, by every method, and never worse than the guess."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fsmsm_jax.alignment.caer import caer_at
from fsmsm_jax.alignment.kernels import BeamModel, GemanMcClure, PseudoHuber
from fsmsm_jax.alignment.refine import METHODS, refine
from fsmsm_jax.evaluation.metrics import pose_errors, success
from fsmsm_jax.sensing import Lidar, Scan, raycast
from tests.worlds import CENTRE, rasterised_room, square_room, star

RAYS, SIGMA, TRIALS = 180, 0.02, 48
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
FAR = jnp.asarray(100.0)
WORLDS = jax.tree.map(lambda *a: jnp.stack(a), *[star(seed) for seed in range(TRIALS)])

GRID = rasterised_room(yaw=0.3, resolution=0.1)[0]

every_method = pytest.mark.parametrize("method", METHODS)


def scan_of(ranges, valid=None):
    valid = jnp.ones(RAYS, bool) if valid is None else valid
    return Scan(ranges, BEARINGS, valid, valid, FAR)


def trial(blocked=0.0, off=0.1, turn=np.radians(5)):
    """Scans taken in star rooms, with noise and blocked rays, and initial poses."""
    rng = np.random.default_rng(3)
    xy = CENTRE + rng.uniform(-0.2, 0.2, (TRIALS, 2))
    true = np.column_stack([xy, rng.uniform(-3, 3, TRIALS)])
    way, side = rng.uniform(-3, 3, TRIALS), rng.choice([-1, 1], TRIALS)
    start = true + np.column_stack([off * np.cos(way), off * np.sin(way), turn * side])
    true = jnp.asarray(true, float)
    ranges = np.asarray(clean(WORLDS, true))
    short = rng.uniform(size=ranges.shape) < blocked
    ranges = np.where(short, ranges * rng.uniform(0.2, 0.9, ranges.shape), ranges)
    ranges += SIGMA * rng.standard_normal(ranges.shape)
    return true, jnp.asarray(start, float), jnp.asarray(ranges, float)


clean = jax.jit(lambda worlds, poses: jax.vmap(raycast, (0, 0, None))(worlds, poses, BEARINGS))  # fmt: skip


@partial(jax.jit, static_argnames=("method", "steps"))
def run(worlds, ranges, starts, kernel, method="gauss_newton", steps=None):
    one = lambda world, r, p: refine(world, scan_of(r), p, method, kernel, steps)
    return jax.vmap(one)(worlds, ranges, starts)


@every_method
def test_home_from_ten_centimetres_and_five_degrees(method):
    true, start, ranges = trial()
    found = run(WORLDS, ranges, start, GemanMcClure(), method)
    home = success(found.pose, true, 0.05, np.radians(1))
    assert np.mean(home) >= 47 / 48
    assert np.mean(found.converged) >= 47 / 48
    position, _ = pose_errors(found.pose, true)
    # √(2/180) σ = 2 mm is about the bound of 180 rays; adam may be a little short of it.
    assert np.median(position) < 2 * SIGMA * np.sqrt(2 / RAYS)
    before = jax.vmap(lambda w, r, p: caer_at(w, scan_of(r), p, GemanMcClure()))
    assert bool(jnp.all(found.cost < before(WORLDS, ranges, start)))
    np.testing.assert_allclose(found.thickness, 0.0)  # polygons have none


def test_blocked_rays_lose_their_vote():
    true, start, ranges = trial(blocked=0.3)
    error = {}
    for kernel in (PseudoHuber(50.0), GemanMcClure(), BeamModel()):
        found = run(WORLDS, ranges, start, kernel)
        error[type(kernel).__name__] = np.median(pose_errors(found.pose, true)[0])
    # A Huber kernel 50 m wide is least squares: every ray votes by its size.
    least_squares = error["PseudoHuber"]
    assert least_squares > 0.03
    for robust in ("GemanMcClure", "BeamModel"):
        # 126 honest rays of noise σ: 2.5 mm; twice that is good.
        assert error[robust] < 2 * SIGMA * np.sqrt(2 / (0.7 * RAYS))


def test_eager_is_jit_and_candidates_are_the_loop_and_cost_is_the_objective():
    true, _, ranges = trial()
    world, scan = star(0), scan_of(ranges[0])
    away = jnp.array([[0.05, 0, 0.02], [-0.05, 0.08, 0], [0.4, 0.4, 1]])
    starts = true[:1] + away
    batch = jax.jit(jax.vmap(refine, (None, None, 0)))(world, scan, starts)
    for index, start in enumerate(starts):
        one = refine(world, scan, start)
        np.testing.assert_allclose(batch.pose[index], one.pose, atol=2e-4)
        assert float(batch.cost[index]) == pytest.approx(float(one.cost), rel=1e-3)
        cost = caer_at(world, scan, one.pose, GemanMcClure())
        assert float(one.cost) == pytest.approx(float(cost), rel=1e-4)
        mean = caer_at(world, scan, one.pose) / RAYS
        assert float(one.caer_per_ray) == pytest.approx(float(mean), rel=1e-4)
    assert int(jnp.argmin(batch.cost)) != 2
    assert batch.caer_per_ray.shape == batch.converged.shape == (3,)


def test_walls_drawn_thick_are_found_out_on_grids():
    """In a painted room whose walls stand 0.1 m nearer than those the sensor sees."""
    drawn, _ = rasterised_room(yaw=0.3, side=6.0, resolution=0.025)
    _, real = rasterised_room(yaw=0.3, side=6.2, resolution=0.025)
    middle = np.asarray(real.start.mean(axis=0))
    _, outline = rasterised_room(yaw=0.3, side=6.0, resolution=0.025)
    shift = np.asarray(outline.start.mean(axis=0)) - middle
    real = jax.tree.map(lambda ends: ends + jnp.asarray(shift, float)[None], real)
    lidar = Lidar.create(120, 1.0 * np.pi, noise=0.0)  # what is behind is not seen
    true = jnp.asarray([*(middle + shift + [0.6, -0.4]), 0.5], float)
    scan = lidar.measure(jax.random.key(0), raycast(real, true, lidar.bearings))
    found = refine(drawn, scan, true + jnp.array([0.05, -0.05, 0.05]))
    position, turn = pose_errors(found.pose, true)
    assert float(found.thickness) == pytest.approx(0.1, abs=0.03)
    assert float(position) < 0.03
    assert float(turn) < np.radians(1)


def test_nothing_seen_nothing_learned():
    start = jnp.asarray([*CENTRE, 0.4], float)
    blind = scan_of(jnp.full(RAYS, 5.0), jnp.zeros(RAYS, bool))
    outside = start.at[:2].add(5e3)
    for scan, pose in ((blind, start), (scan_of(jnp.full(RAYS, 5.0)), outside)):
        found = refine(square_room(), scan, pose)
        np.testing.assert_allclose(found.pose, pose, atol=1e-6)
        assert not bool(found.converged)


@partial(jax.jit, static_argnames="method")
def short_run(scan, pose, width, method):
    kernel = GemanMcClure(width)
    found = refine(GRID, scan, pose, method, kernel, 3, (1.0,))
    return jnp.append(found.pose, found.cost), caer_at(GRID, scan, pose, kernel)


@every_method
@settings(max_examples=15)
@given(
    pose=st.tuples(*[st.floats(-8, 8, width=32)] * 3),
    ranges=st.lists(st.floats(0.0, 40.0, width=32), min_size=30, max_size=30),
    width=st.sampled_from([1e-3, 0.2, 50.0]),
    seen=st.integers(0, 30),
)
def test_any_scan_any_pose_gives_numbers_and_no_more_cost(
    method, pose, ranges, width, seen
):
    valid = jnp.arange(30) < seen
    bearings = jnp.linspace(-2, 2, 30)
    r = jnp.asarray(ranges, float)
    scan = Scan(r, bearings, valid, valid & (r < 30), jnp.asarray(30.0))
    start = jnp.asarray(pose, float).at[:2].add(jnp.asarray(CENTRE, float))
    found, cost = short_run(scan, start, jnp.asarray(width), method)
    assert bool(jnp.isfinite(found).all())
    assert float(found[3]) <= float(cost) * (1 + 1e-5) + 1e-5


def test_what_is_refused():
    scan, pose = scan_of(jnp.full(RAYS, 5.0)), jnp.zeros(3)
    with pytest.raises(
        ValueError, match="no method 'newton': choose from gauss_newton"
    ):
        refine(square_room(), scan, pose, "newton")
    for options in ({"steps": 0}, {"steps": -3}, {"widening": ()}):
        with pytest.raises(ValueError, match="at least one step in at least one stage"):
            refine(square_room(), scan, pose, **options)


def test_numbers_are_leaves_and_dtypes_are_kept_under_x64():
    traces = []

    @jax.jit
    def once(pose, width, widest):
        traces.append(1)
        widening = (widest, 1.0)
        scan = scan_of(jnp.full(RAYS, 2.0))
        return refine(square_room(), scan, pose, kernel=GemanMcClure(width), widening=widening)  # fmt: skip

    pose = jnp.asarray([*CENTRE, 0.1], float)
    for width, widest in ((0.1, 2.0), (0.2, 4.0)):
        once(pose, width, widest)
    assert len(traces) == 1
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(
            lambda a: a.astype(float) if a.dtype == np.float32 else a, tree
        )
        room, scan = double(square_room()), double(scan_of(jnp.full(RAYS, 2.0)))
        found = jax.eval_shape(refine, room, scan, jnp.zeros(3, float))
        for leaf in (found.pose, found.cost, found.caer_per_ray, found.thickness):
            assert leaf.dtype == np.float64
