"""Poses that are known roughly: a mean and a covariance, moved and averaged.

The two lines of a Kalman filter, on planar poses. Covariances are in the map frame
[m, m, rad]², headings are linearised about the mean; a degree or ten bear that.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.information import definite

__all__ = ["mean", "moved"]


def moved(
    pose: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    motion: Float[Array, "3"],
    spread: Float[Array, "3 3"],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """A pose and its covariance after a motion.

    Args:
        pose: before it, in the map frame [m, m, rad].
        covariance: of the pose.
        motion: the new pose in the frame of the old one [m, m, rad].
        spread: covariance of the motion, in the same frame.
    """
    after = geometry.compose(pose, motion)
    dx, dy, _ = after - pose
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    F = jnp.eye(3, dtype=pose.dtype).at[0, 2].set(-dy).at[1, 2].set(dx)
    G = jnp.eye(3, dtype=pose.dtype).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
    return after, F @ covariance @ F.T + G @ spread @ G.T


def mean(
    a: Float[Array, "3"],
    P: Float[Array, "3 3"],
    b: Float[Array, "3"],
    L: Float[Array, "3 3"],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, ""]]:
    """Weighted mean of two independent poses.

    Args:
        a: one pose [m, m, rad].
        P: its covariance.
        b: the other.
        L: lower triangular root of its covariance, L Lᵀ (`covariance_root`).

    Returns:
        The mean, its covariance, and the squared Mahalanobis distance of the two.

    Note:
        A square-root filter: a + C u with C Cᵀ = P, where u is small, and L⁻¹ C u near
        L⁻¹ (b − a), all with unit variance; least squares by QR. L Lᵀ is never formed:
        float32 then bears 10 m beside a millimetre, along any axes.

    Reference:
        G. Bierman, "Factorization Methods for Discrete Sequential Estimation", 1977.
    """
    away = b - a
    away = away.at[2].set(geometry.wrap(away[2]))
    C = jnp.linalg.cholesky(definite(P))
    seen = jnp.concatenate([C, away[:, None]], axis=1)
    seen = jax.scipy.linalg.solve_triangular(L, seen, lower=True)
    expected = jnp.eye(3, 4, dtype=P.dtype)
    R = jnp.linalg.qr(jnp.concatenate([expected, seen]), mode="r")
    W = jax.scipy.linalg.solve_triangular(R[:3, :3], C.T, trans=1).T
    pose = a + W @ R[:3, 3]
    return pose.at[2].set(geometry.wrap(pose[2])), definite(W @ W.T), R[3, 3] ** 2
