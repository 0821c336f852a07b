import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from fsmsm_jax.alignment.kernels import (
    Absolute,
    BeamModel,
    GemanMcClure,
    PseudoHuber,
    Truncated,
)

KERNELS = (
    Absolute(),
    PseudoHuber(0.05),
    GemanMcClure(0.2),
    Truncated(0.5),
    BeamModel(0.1, short=0.2, long=0.01),
)
every_kernel = pytest.mark.parametrize(
    "kernel", KERNELS, ids=lambda k: type(k).__name__
)

# Both signs, five decades, and on neither side of 0.5 to the last digit.
SIZES = np.geomspace(2e-3, 100.1, 200)
ERRORS = np.concatenate([-SIZES[::-1], SIZES])


@every_kernel
def test_weight_is_slope_over_error(kernel):
    with jax.enable_x64(True):
        e = jnp.asarray(ERRORS)
        h = 1e-6 * jnp.abs(e)
        slope = (kernel.cost(e + h) - kernel.cost(e - h)) / (2 * h)
        scale = kernel.weight(jnp.asarray([2e-3]))  # of costs that have gone flat
        np.testing.assert_allclose(
            kernel.weight(e), slope / e, rtol=1e-5, atol=1e-7 * float(scale[0])
        )


@every_kernel
def test_cost_starts_at_nought_and_never_falls(kernel):
    assert float(kernel.cost(jnp.zeros(()))) == 0.0
    e = jnp.asarray(SIZES, float)
    for side in (e, -e):
        cost = np.asarray(kernel.cost(side))
        assert (cost > 0).all()
        assert (np.diff(cost) >= 0).all()
        assert (cost <= np.maximum(SIZES, 0.5) * (1 + 1e-6)).all()  # in metres


@pytest.mark.parametrize("kernel", KERNELS[:4], ids=lambda k: type(k).__name__)
def test_most_kernels_are_even(kernel):
    e = jnp.asarray(SIZES, float)
    np.testing.assert_array_equal(kernel.cost(e), kernel.cost(-e))
    np.testing.assert_array_equal(kernel.weight(e), kernel.weight(-e))


def test_what_each_kernel_is_in_the_limit():
    e = jnp.asarray([-30.0, -0.7, 0.3, 12.0])
    np.testing.assert_allclose(PseudoHuber(1e-4).cost(e), jnp.abs(e), atol=2e-4)
    np.testing.assert_allclose(Truncated(100.0).cost(e), Absolute().cost(e))
    assert float(GemanMcClure(0.2).cost(jnp.asarray(0.2))) == pytest.approx(0.1)
    np.testing.assert_allclose(GemanMcClure(0.2).cost(1e3 * e), 0.2, rtol=1e-5)
    # Without a background, a Gaussian: the parabola e² / 2σ² in units of σ.
    small = jnp.asarray([-0.2, 0.0, 0.1])
    gauss = BeamModel(0.1, short=1e-9, long=1e-9).cost(small)
    np.testing.assert_allclose(gauss, small**2 / 0.2, atol=1e-6)


def test_beam_model_forgives_the_short_ray_and_not_the_long_one():
    kernel = BeamModel(0.1, short=0.2, long=0.01)
    cost = lambda e: float(kernel.cost(jnp.asarray(e)))
    assert cost(-3.0) == pytest.approx(0.1 * np.log(1 + 1 / 0.2))
    assert cost(3.0) == pytest.approx(0.1 * np.log(1 + 1 / 0.01))
    # Noise alone pushes nowhere: the sides part only where noise hardly reaches.
    assert cost(-0.05) == pytest.approx(cost(0.05), rel=0.25)
    step = 1e-4
    assert cost(step) == pytest.approx(cost(-step), abs=1e-6)


@every_kernel
def test_widened_is_the_same_shape_at_a_larger_scale(kernel):
    e = jnp.asarray(ERRORS, float)
    wide = kernel.widened(4.0)
    assert type(wide) is type(kernel)
    np.testing.assert_allclose(wide.cost(4 * e), 4 * kernel.cost(e), rtol=1e-4)
    traced = jax.jit(lambda factor: kernel.widened(factor).cost(e))(4.0)
    np.testing.assert_allclose(traced, wide.cost(e), rtol=1e-4, atol=1e-6)


@every_kernel
@given(
    e=st.floats(-1e4, 1e4, width=32),
    factor=st.floats(0.125, 64, width=32),
)
def test_costs_weights_and_slopes_are_finite(kernel, e, factor):
    numbers = _all_of(kernel, jnp.asarray(e, float), jnp.asarray(factor, float))
    assert bool(jnp.isfinite(numbers).all())
    assert float(numbers[0]) >= 0
    assert float(numbers[1]) >= 0


@jax.jit
def _all_of(kernel, e, factor):
    wide = kernel.widened(factor)
    cost = wide.cost(e)
    return jnp.stack([cost, wide.weight(e), jax.grad(wide.cost)(e)])


@every_kernel
def test_dtypes_are_kept_under_x64(kernel):
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            e = jax.ShapeDtypeStruct((4,), dtype)
            for shape in jax.eval_shape(
                lambda e: (kernel.cost(e), kernel.weight(e)), e
            ):
                assert shape.dtype == dtype
