import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from jax.test_util import check_grads

from fsmsm_jax import geometry
from fsmsm_jax.alignment.orientation import (
    METHODS,
    first_principles,
    fourier_mellin,
    fourier_mellin_masked,
    heading_costs,
    percent_discrimination,
    procrustes_trace,
    turned,
)
from fsmsm_jax.alignment.spectrum import (
    Spectrum,
    circular_correlation,
    first_harmonic,
)
from fsmsm_jax.sensing import raycast
from tests.oracles import alignment as oracle
from tests.worlds import CENTRE, l_room

RAYS = 180
GAMMA = 2 * np.pi / RAYS
BEARINGS = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
FULL = np.ones(RAYS, bool)
AHEAD = np.abs(BEARINGS) <= np.pi / 2


@pytest.fixture(scope="module")
def cast():
    """Scans of the L-room from its centre (or beside it), by heading."""
    bearings, room = jnp.asarray(BEARINGS, float), l_room()

    @jax.jit
    def cast(heading, dx=0.0, dy=0.0):
        pose = jnp.stack([CENTRE[0] + dx, CENTRE[1] + dy, heading])
        return raycast(room, pose, bearings)

    return lambda heading, *shift: cast(jnp.asarray(heading, float), *shift)


plain = jax.jit(fourier_mellin)
masked = jax.jit(fourier_mellin_masked)
jitted = {name: jax.jit(method) for name, method in METHODS.items()}
jitted["phase_only"] = jax.jit(lambda r, v: fourier_mellin(r, v, phase_only=True))


def difference(a, b):
    """Angle between two angles [rad], in [−π, π)."""
    return np.mod(np.asarray(a, float) - b + np.pi, 2 * np.pi) - np.pi


@pytest.fixture(params=jitted)
def method(request):
    return jitted[request.param]


def test_every_method_adds_what_the_estimate_lacks(cast, method):
    virtual = cast(0.3)
    for turn in [*range(-90, 90, 11), -1, 0, 1]:
        found = method(cast(0.3 + turn * GAMMA), virtual)
        for angle in (found.correction, found.refined):
            error = difference(angle, turn * GAMMA)
            np.testing.assert_allclose(error, 0, atol=1e-3 * GAMMA)
            assert -np.pi - 1e-6 <= float(angle) < np.pi
        assert float(found.similarity) == pytest.approx(1, abs=1e-6)


def test_every_method_turns_with_either_scan(cast, method):
    r, v = cast(1.0, 0.2, -0.1), cast(0.4)
    found = method(r, v)
    for k in (-45, 3, 89):
        ahead, back = method(r, jnp.roll(v, k)), method(jnp.roll(r, k), v)
        for name in ("correction", "refined"):
            angle = getattr(found, name)
            for other, sign in ((ahead, 1), (back, -1)):
                turn = difference(getattr(other, name), angle)
                np.testing.assert_allclose(
                    difference(turn, sign * k * GAMMA), 0, atol=1e-4
                )
        np.testing.assert_allclose(ahead.similarity, found.similarity, atol=1e-6)


def test_every_method_undoes_itself_with_the_scans_exchanged(cast, method):
    for heading, dx, dy in ((1.0, 0.2, -0.1), (-2.5, -0.4, 0.3)):
        r, v = cast(heading, dx, dy), cast(0.4)
        there, back = method(r, v), method(v, r)
        for name in ("correction", "refined"):
            a, b = getattr(there, name), getattr(back, name)
            np.testing.assert_allclose(difference(a, -float(b)), 0, atol=1e-4)
        np.testing.assert_allclose(there.similarity, back.similarity, atol=1e-6)


def test_every_method_is_blind_to_the_scale(cast, method):
    r, v = cast(1.0, 0.2, -0.1), cast(0.4)
    for a, b in zip(method(r, v), method(3 * r, 3 * v), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_every_method_leaves_equal_scans_alone(cast, method):
    for scan in (cast(0.3), cast(-2.0, 0.5, 0.1)):
        found = method(scan, scan)
        np.testing.assert_allclose(found.correction, 0, atol=1e-6)
        assert float(found.similarity) == 1


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_the_same_under_jit_vmap_and_half_the_digits(cast, name):
    reals = jnp.stack([cast(0.3 + t, 0.05 * t) for t in (-2.0, 0.1, 1.7)])
    virtual = cast(0.3)
    together = jax.jit(jax.vmap(METHODS[name], (0, None)))(reals, virtual)
    eager = METHODS[name](reals[0], virtual)
    for i, real in enumerate(reals):
        alone = jitted[name](real, virtual)
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_allclose(a, b[i], atol=1e-4)
    np.testing.assert_allclose(eager, [a[0] for a in together], atol=1e-4)
    with jax.enable_x64(True):
        wide = [jnp.asarray(np.asarray(x), np.float64) for x in (reals, virtual)]
        exact = jax.jit(jax.vmap(METHODS[name], (0, None)))(*wide)
        for a, b in zip(exact, together, strict=True):
            assert a.dtype == np.float64
            assert b.dtype == np.float32
            np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.parametrize("scan", ["round", "nothing", "one ray"])
def test_every_method_is_finite_where_no_heading_shows(method, scan):
    ring = jnp.full(RAYS, {"round": 4.7, "nothing": 0.0, "one ray": 0.0}[scan])
    if scan == "one ray":
        ring = ring.at[20].set(5.0)
    for found in (method(ring, ring), method(ring, ring + 1), method(2 * ring, ring)):
        assert np.isfinite(np.asarray(found)).all()


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_every_method_stands_noise(cast, noise):
    """Grid methods hardly leave their ray; the first harmonic errs as it must."""
    virtual, turn, trials = cast(0.3), 31, 200
    draws = np.random.default_rng(0).normal(0, noise, (trials, RAYS))
    reals = jnp.roll(virtual, -turn)[None] + jnp.asarray(draws, float)
    for name, method in METHODS.items():
        found = jax.jit(jax.vmap(method, (0, None)))(reals, virtual)
        error = difference(found.correction, turn * GAMMA)
        if name == "first_principles":
            # Var arg R₁ = σ² (N/2) / |R₁|²; the spread is known to 1 / √(2 trials).
            expected = noise * np.sqrt(RAYS / 2) / abs(first_harmonic(virtual))
            assert np.std(error) == pytest.approx(expected, rel=4 / np.sqrt(2 * trials))
            assert abs(np.mean(error)) < 4 * expected / np.sqrt(trials)
        else:
            assert np.mean(np.abs(error) < 0.5 * GAMMA) >= 0.99


@pytest.mark.parametrize("rays", [15, 36])
def test_procrustes_by_spectra_is_procrustes_by_svd_and_the_correlation(rays):
    rng = np.random.default_rng(rays)
    with jax.enable_x64(True):
        for _ in range(5):
            r, v = rng.uniform(1, 12, (2, rays))
            trace = np.asarray(procrustes_trace(jnp.asarray(r), jnp.asarray(v)))
            np.testing.assert_allclose(
                trace, oracle.procrustes_traces(r, v), rtol=1e-12
            )
            q = circular_correlation(jnp.asarray(r), jnp.asarray(v))
            np.testing.assert_allclose(trace, q, rtol=1e-12)


def test_procrustes_answers_as_fourier_mellin_does(cast):
    for heading, dx, dy in ((1.0, 0.2, -0.1), (-2.5, -0.4, 0.3), (3.0, 0.0, 0.0)):
        r, v = cast(heading, dx, dy), cast(0.4)
        for a, b in zip(jitted["procrustes"](r, v), plain(r, v), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-2 * GAMMA)


def test_first_principles_bends_smoothly_and_rests_in_a_round_room(cast):
    correction = lambda r, v: first_principles(r, v).correction
    slope = jax.jit(jax.grad(correction, argnums=(0, 1)))
    r, v = cast(1.0, 0.2, -0.1), cast(0.4)
    with jax.enable_x64(True):
        wide = [jnp.asarray(np.asarray(x), np.float64) for x in (r, v)]
        check_grads(jax.jit(correction), wide, order=1, modes=("fwd", "rev"))
    ring = jnp.full(RAYS, 4.7)
    for scans in ((ring, ring), (ring, v), (r, ring), (ring * 0, ring)):
        assert float(correction(*scans)) == 0
        assert all(np.isfinite(g).all() for g in slope(*scans))


def test_shift_and_similarity_are_those_of_the_loop(cast):
    r, v = cast(1.0, 0.2, -0.1), cast(0.4)
    q = oracle.correlation(np.asarray(r, float), np.asarray(v, float))
    for name in METHODS:
        found = jitted[name](r, v)
        k = round(float(found.correction) / GAMMA) % RAYS
        if name != "first_principles":
            assert k == np.argmax(q)
        discrimination = 2 * q[k] / float(jnp.sum(r**2) + jnp.sum(v**2))
        again = percent_discrimination(r, turned(v, found.correction))
        for similarity in (found.similarity, again):
            assert float(similarity) == pytest.approx(discrimination, abs=1e-6)
        assert 0.5 < discrimination < 1


def test_interpolation_beats_the_grid_of_rays(cast):
    turns = np.linspace(0.05, 0.95, 10)
    error = {"correction": [], "refined": []}
    for turn in turns:
        found = plain(cast(0.3 + turn * GAMMA), cast(0.3))
        for name, errors in error.items():
            errors.append(abs(float(getattr(found, name)) / GAMMA - turn))
    assert np.mean(error["refined"]) < 0.4 * np.mean(error["correction"])
    assert max(error["refined"]) < 0.25


@given(st.integers(-90, 89))
@settings(max_examples=20)
def test_full_masks_give_the_plain_answer(cast, turn):
    r, v = cast(0.3 + turn * GAMMA, 0.1, -0.2), cast(0.3)
    for a, b in zip(plain(r, v), masked(r, FULL, v, FULL), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3 * GAMMA)


@pytest.mark.parametrize("missing", [0.0, 30.0])
def test_half_a_scan_is_enough_with_its_mask_and_misleads_without(cast, missing):
    virtual = cast(0.3)
    misled = 0
    for turn in range(-90, 90, 12):
        half = jnp.where(AHEAD, cast(0.3 + turn * GAMMA), missing)
        found = masked(half, AHEAD, virtual, FULL)
        error = geometry.wrap(found.correction - turn * GAMMA)
        np.testing.assert_allclose(error, 0, atol=1e-5)
        assert float(found.similarity) == pytest.approx(1, abs=1e-5)
        wrong = geometry.wrap(plain(half, virtual).correction - turn * GAMMA)
        misled += abs(float(wrong)) > 5 * GAMMA
    assert misled > 7  # of 15; right only when it looks at the deep side anyway


def test_holes_in_the_virtual_scan_cost_nothing_either(cast):
    unknown = (BEARINGS < -2) | (BEARINGS > -1.2)
    half = jnp.where(AHEAD, cast(0.3 - 20 * GAMMA), 30.0)
    found = masked(half, AHEAD, jnp.where(unknown, cast(0.3), 30.0), unknown)
    np.testing.assert_allclose(found.correction, -20 * GAMMA, atol=1e-5)


def test_headings_that_compare_too_few_rays_are_out(cast):
    r, v = cast(0.3), cast(0.3)
    R, V = Spectrum.of(r, jnp.asarray(AHEAD)), Spectrum.of(v, jnp.asarray(AHEAD))
    overlap = np.array([np.sum(AHEAD & np.roll(AHEAD, -k)) for k in range(RAYS)])
    for share in (0.0, 0.25, 0.9):
        possible = np.isfinite(heading_costs(R, V, share))
        needed = max(share * AHEAD.sum(), 1)
        np.testing.assert_array_equal(possible, overlap >= needed)


@pytest.mark.parametrize("empty", ["real", "virtual", "both", "too little"])
def test_without_anything_to_compare_nothing_is_claimed(cast, empty):
    none = ~FULL
    mask = AHEAD if empty in ("virtual", "too little") else none
    virtual_mask = FULL if empty == "real" else none
    if empty == "too little":
        virtual_mask = BEARINGS > 3
    found = masked(cast(0.3), mask, cast(1.3), virtual_mask)
    assert [float(a) for a in found] == [0.0, 0.0, 0.0]


def test_vmap_is_the_loop_and_jit_the_eager_answer(cast):
    reals = jnp.stack([cast(0.3 + t, 0.05 * t) for t in (-2.0, 0.1, 1.7)])
    rest = jnp.asarray(AHEAD), cast(0.3), jnp.asarray(FULL)
    batch = jax.jit(jax.vmap(fourier_mellin_masked, (0, None, None, None)))
    together = batch(reals, *rest)
    for i, real in enumerate(reals):
        for a, b in zip(masked(real, *rest), together, strict=True):
            np.testing.assert_allclose(a, b[i], atol=1e-4)
    for a, b in zip(fourier_mellin_masked(reals[0], *rest), together, strict=True):
        np.testing.assert_allclose(a, b[0], atol=1e-4)


def test_dtypes_are_kept_under_x64():
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            r, mask = jnp.ones(RAYS, dtype), jnp.ones(RAYS, bool)
            answers = lambda r, m: (
                fourier_mellin(r, r),
                fourier_mellin_masked(r, m, r, m),
            )
            shapes = jax.eval_shape(answers, r, mask)
            assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {np.dtype(dtype)}
