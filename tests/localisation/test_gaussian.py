"""Moving and averaging poses, against the textbook's Kalman filter in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation.gaussian import mean, moved
from tests.worlds import CENTRE

RNG = np.random.default_rng(4)


def kalman(a, P, b, R):
    """The update of a Kalman filter that measures all of its state."""
    away = b - a
    away[2] = np.mod(away[2] + np.pi, 2 * np.pi) - np.pi
    K = P @ np.linalg.inv(P + R)
    return a + K @ away, P - K @ P, away @ np.linalg.solve(P + R, away)


def root(sigma, slant):
    """Lower triangular, of a covariance whose first two axes are turned by `slant`."""
    c, s = np.cos(slant), np.sin(slant)
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.linalg.qr((axes * sigma).T)[1].T, axes


@pytest.mark.parametrize("slant", [0.0, 0.8, -1.3])
@pytest.mark.parametrize("along", [0.01, 1.0, 10.0])
def test_mean_is_the_textbooks(along, slant):
    """However long and slant the axes of what the scan knows.

    The odometry's covariance of 0.3 m² is float32's to 2e-8 m², against (1 mm)²: a
    hundredth of the variance across, a tenth of a standard deviation of the mean.
    """
    L, axes = root([along, 1e-3, 5e-4], slant)
    P = axes @ np.diag([0.5, 0.02, 0.01]) ** 2 @ axes.T
    a = np.append(CENTRE, 3.1)
    b = a + axes @ np.array([0.3, 0.01, 0.02])
    expected, C, distance = kalman(a, P, b, L @ L.T)
    found, spread, d2 = jax.jit(mean)(*(jnp.asarray(v, float) for v in (a, P, b, L)))
    off = axes.T @ (np.asarray(found, float) - expected)
    off[2] = np.mod(off[2] + np.pi, 2 * np.pi) - np.pi
    sigma = np.sqrt(np.diagonal(axes.T @ C @ axes))
    # At 30 m, float32 tells 2e-6 m apart.
    assert (np.abs(off) < 0.1 * sigma + 4e-6).all()
    turned = axes.T @ np.asarray(spread, float) @ axes
    np.testing.assert_allclose(np.diagonal(turned), sigma**2, rtol=0.05)
    np.testing.assert_allclose(d2, distance, rtol=0.02)
    assert np.linalg.eigvalsh(np.asarray(spread, float)).min() > 0


def test_gradients_of_the_mean():
    """By both opinions, against central differences of step 1e-2 σ."""
    L, axes = root([0.3, 2e-2, 1e-2], 0.8)
    P = axes @ np.diag([0.2, 0.05, 0.02]) ** 2 @ axes.T
    a = np.append(CENTRE, 0.4)
    b = a + np.array([0.1, -0.1, 0.02])
    P, a, b, L = (jnp.asarray(v, float) for v in (P, a, b, L))
    of = lambda L: mean(a, P, b, L)[2]
    way = np.tril(RNG.normal(size=(3, 3))) * np.asarray(L)
    slope = float(jnp.sum(jax.grad(of)(L) * way))
    h = 1e-2
    rise = float(of(L + h * way) - of(L - h * way)) / (2 * h)
    assert slope == pytest.approx(rise, rel=1e-2)


def test_moved_is_the_scatter_of_moved_samples():
    """Of 200 000 samples: their covariance is known to 3 σ = 1 % of each entry's scale;
    linearising headings that scatter by 0.02 rad costs 2e-4 of it."""
    pose, motion = np.append(CENTRE, 2.2), np.array([0.5, -0.2, 0.4])
    P = np.diag([0.05, 0.03, 0.02]) ** 2
    Q = np.diag([0.02, 0.01, 0.01]) ** 2
    many = 200_000
    before = RNG.multivariate_normal(pose, P, many)
    moves = RNG.multivariate_normal(motion, Q, many)
    after = jax.vmap(geometry.compose)(jnp.asarray(before), jnp.asarray(moves))
    there = (jnp.asarray(v, float) for v in (pose, P, motion, Q))
    middle, C = moved(*there)
    off = np.asarray(after, float) - np.asarray(middle, float)
    off[:, 2] = np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi
    scatter, C = off.T @ off / many, np.asarray(C, float)
    sigma = np.sqrt(np.diagonal(C))
    np.testing.assert_allclose(
        scatter / np.outer(sigma, sigma), C / np.outer(sigma, sigma), atol=0.01
    )
