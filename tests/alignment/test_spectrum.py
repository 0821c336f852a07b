import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fsmsm_jax.alignment.spectrum import (
    Spectrum,
    circular_correlation,
    first_harmonic,
    masked_squared_difference,
    peak_offset,
    phase_correlation,
    squared_difference,
)
from tests.oracles import alignment as oracle

SIZES = (15, 16)  # a half spectrum of 15 has as many bins as one of 14


def signals(rays, seed=0):
    """Two scans with holes, ranges far from zero."""
    rng = np.random.default_rng(seed)
    r, v = rng.uniform(3, 12, (2, rays))
    mask_r, mask_v = rng.uniform(size=(2, rays)) < 0.7
    return r, mask_r, v, mask_v


def to_jax(*arrays):
    return [jnp.asarray(a, None if a.dtype == bool else float) for a in arrays]


@pytest.mark.parametrize("rays", SIZES)
def test_first_harmonic_is_the_sum_by_definition(rays):
    r = signals(rays)[0]
    np.testing.assert_allclose(
        first_harmonic(*to_jax(r)), oracle.first_harmonic(r), rtol=1e-5
    )


@pytest.mark.parametrize("rays", SIZES)
def test_correlation_is_the_sum_by_definition(rays):
    r, _, v, _ = signals(rays)
    q = circular_correlation(*to_jax(r, v))
    np.testing.assert_allclose(q, oracle.correlation(r, v), rtol=2e-6)


@given(st.integers(-40, 40))
@settings(max_examples=20)
def test_a_scan_turned_by_k_rays_peaks_at_k(k):
    r = jnp.asarray(signals(36)[0], float)
    turned = jnp.roll(r, k)
    for correlation in (circular_correlation, phase_correlation):
        assert int(jnp.argmax(correlation(r, turned))) == k % 36


def test_phase_correlation_of_turned_scans_is_a_spike_even_without_some_frequencies():
    wave = 5 + jnp.sin(2 * jnp.pi * jnp.arange(16) / 16)  # two frequencies only
    q = phase_correlation(wave, jnp.roll(wave, 3))
    assert bool(jnp.isfinite(q).all())
    r = jnp.asarray(signals(16)[0], float)
    np.testing.assert_allclose(
        phase_correlation(r, jnp.roll(r, 3)), np.eye(16)[3], atol=1e-6
    )


@pytest.mark.parametrize("rays", SIZES)
@pytest.mark.parametrize("holes", ["both", "real", "none", "all"])
def test_masked_difference_counts_exactly_the_rays_that_both_know(rays, holes):
    r, mask_r, v, mask_v = signals(rays, seed=rays)
    if holes != "both":
        mask_v = np.ones(rays, bool)
    if holes == "none":
        mask_r = np.ones(rays, bool)
    if holes == "all":
        mask_r = np.zeros(rays, bool)
    total, count = oracle.squared_difference(r, mask_r, v, mask_v)
    D, overlap = masked_squared_difference(*to_jax(r, mask_r, v, mask_v))
    np.testing.assert_array_equal(overlap, count)
    np.testing.assert_allclose(D, total, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("apart", [0.0, 3.0])
def test_float32_keeps_its_digits_on_long_ranges(apart):
    """The bound of the docstring; without the offsets it fails by a factor of 100."""
    rng = np.random.default_rng(3)
    r = 80 + rng.normal(0, 1, 360)
    v = np.roll(r, 40) + rng.normal(0, 0.01, 360) + apart
    r, v = r.astype(np.float32), v.astype(np.float32)
    mask = np.abs(np.arange(360) - 180) < 90
    full = np.ones(360, bool)
    D, _ = jax.jit(masked_squared_difference)(*to_jax(r, mask, v, full))
    exact, _ = oracle.squared_difference(r.astype(float), mask, v.astype(float), full)
    centre = v.astype(float).mean()
    energy = np.sum((r[mask] - centre) ** 2) + np.sum((v - centre) ** 2)
    assert np.abs(D - exact).max() < 1e-6 * energy


def test_full_masks_give_energies_less_twice_the_correlation():
    r, _, v, _ = to_jax(*signals(36))
    full = jnp.ones(36, bool)
    D, overlap = masked_squared_difference(r, full, v, full)
    q = circular_correlation(r, v)
    np.testing.assert_allclose(D, jnp.sum(r**2) + jnp.sum(v**2) - 2 * q, rtol=1e-4)
    np.testing.assert_array_equal(overlap, 36)


def test_a_database_of_spectra_answers_as_its_scans_one_by_one():
    scans = [to_jax(*signals(36, seed)) for seed in range(4)]
    r, mask_r = scans[0][:2]
    v, mask_v = (jnp.stack([s[i] for s in scans]) for i in (2, 3))
    database = jax.vmap(Spectrum.of)(v, mask_v)
    rank = jax.jit(jax.vmap(squared_difference, in_axes=(None, 0)))
    D, overlap = rank(Spectrum.of(r, mask_r), database)
    for i in range(4):
        one = masked_squared_difference(r, mask_r, v[i], mask_v[i])
        np.testing.assert_allclose(D[i], one[0], rtol=1e-4, atol=1e-3)
        np.testing.assert_array_equal(overlap[i], one[1])


def test_scans_of_different_lengths_are_refused_even_with_equal_bins():
    R, V = (Spectrum.of(jnp.ones(n), jnp.ones(n, bool)) for n in (14, 15))
    assert R.values.shape == V.values.shape
    with pytest.raises(ValueError, match="14 and of 15 rays"):
        squared_difference(R, V)


@given(st.floats(-0.5, 0.5, width=16), st.sampled_from([-1.0, 1.0]))
@settings(max_examples=20)
def test_peak_offset_is_exact_on_parabolas_up_and_down(offset, sign):
    q = sign * (jnp.arange(8.0) - 4 - offset) ** 2
    assert float(peak_offset(q, jnp.asarray(4))) == pytest.approx(offset, abs=1e-6)


def test_peak_offset_wraps_and_survives_flat_and_infinite_neighbours():
    q = jnp.array([0.0, -1.0, -4.0, -9.0, -4.0, -2.0])
    assert float(peak_offset(q, jnp.asarray(0))) == pytest.approx(1 / 6)
    for q in ([1.0, 1.0, 1.0], [jnp.inf, 1.0, jnp.inf], [jnp.inf, 1.0, 2.0]):
        assert float(peak_offset(jnp.array(q), jnp.asarray(1))) == 0.0
    assert float(peak_offset(jnp.full(3, jnp.inf), jnp.asarray(0))) == 0.0


def test_dtypes_are_kept_under_x64():
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            tools = lambda r, mask: (
                first_harmonic(r).real,
                circular_correlation(r, r),
                phase_correlation(r, r),
                peak_offset(r, jnp.argmax(r)),
                masked_squared_difference(r, mask, r, mask),
            )
            shapes = jax.eval_shape(tools, jnp.ones(16, dtype), jnp.ones(16, bool))
            assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {np.dtype(dtype)}
