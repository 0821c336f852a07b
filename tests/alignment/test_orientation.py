import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fsmsm_jax import geometry
from fsmsm_jax.alignment.orientation import (
    fourier_mellin,
    fourier_mellin_masked,
    heading_costs,
)
from fsmsm_jax.alignment.spectrum import Spectrum
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


@given(st.integers(-90, 89))
@settings(max_examples=20)
def test_the_correction_added_to_the_estimate_is_the_true_heading(cast, turn):
    true = 0.3 + turn * GAMMA
    found = plain(cast(true), cast(0.3))
    for angle in (found.correction, found.refined):
        np.testing.assert_allclose(
            geometry.wrap(angle - turn * GAMMA), 0, atol=1e-3 * GAMMA
        )
    assert float(found.similarity) == pytest.approx(1, abs=1e-6)


def test_correction_and_similarity_are_those_of_the_loop(cast):
    r, v = cast(1.0, 0.2), cast(0.4)
    q = oracle.correlation(np.asarray(r, float), np.asarray(v, float))
    found = plain(r, v)
    k = int(np.argmax(q))
    assert float(found.correction) == pytest.approx(k * GAMMA, abs=1e-6)
    discrimination = 2 * q[k] / float(jnp.sum(r**2) + jnp.sum(v**2))
    assert float(found.similarity) == pytest.approx(discrimination, abs=1e-6)
    assert 0.5 < float(found.similarity) < 1


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


def test_a_half_turn_wraps_to_minus_pi(cast):
    found = plain(cast(0.3 + np.pi), cast(0.3))
    np.testing.assert_allclose(abs(found.correction), np.pi, atol=1e-6)
    assert -np.pi - 1e-6 <= float(found.correction) < np.pi


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
