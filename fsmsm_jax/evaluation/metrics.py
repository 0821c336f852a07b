"""How far off a pose is, whether that is right, claimed honestly, and near the bound.

Global localisation fails in two ways that one average would mix up. It may name the
wrong room, so a rate of *right* answers is counted, with limits of a few decimetres
and degrees. Or it may be right and imprecise, so errors are reported of the right
answers only.

How precise can it be? Noise of σ metres in each range leaves any unbiased estimate of
the pose with at least the covariance (JᵀJ/σ²)⁻¹, J being the derivative of the scan by
the pose: the Cramér–Rao bound. It depends on the place. A square room fixes all three
numbers; a circle tells nothing about the heading, and a corridor nothing about the way
along it. Compare *errors* with the bound's root mean square: the median error of an
optimal estimator lies 17 to 33 % under it (σ alike in all directions, or in one only).
How honest is what an estimate says of itself? `nees` weighs errors by its covariance.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.information import cramer_rao_bound

__all__ = ["cramer_rao_bound", "nees", "pose_errors", "position_rms", "success"]


def pose_errors(
    pose: Float[Array, "*batch 3"], reference: Float[Array, "*batch 3"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Distance [m] and angle [rad] between poses [m, m, rad] in the same frame.

    Both are at least 0; the angle is at most π.

    Example:
        >>> truth = jnp.array([4.0, 2.0, 3.0])
        >>> position, orientation = pose_errors(jnp.array([4.3, 2.4, -3.0]), truth)
        >>> round(float(position), 3), round(float(orientation), 3)
        (0.5, 0.283)
    """
    apart = pose - reference
    return (
        jnp.linalg.norm(apart[..., :2], axis=-1),
        jnp.abs(geometry.wrap(apart[..., 2])),
    )


def success(
    pose: Float[Array, "*batch 3"],
    reference: Float[Array, "*batch 3"],
    position: float = 0.3,
    orientation: float = math.radians(5),
) -> Bool[Array, "*batch"]:
    """Whether a pose is right: nearer than both limits to the reference.

    Args:
        pose: estimated poses [m, m, rad]; NaN is never right.
        reference: true poses in the same frame.
        position: limit of the distance [m].
        orientation: limit of the angle [rad].
    """
    metres, radians = pose_errors(pose, reference)
    return (metres < position) & (radians < orientation)


def nees(
    pose: Float[Array, "*batch 3"],
    reference: Float[Array, "*batch 3"],
    covariance: Float[Array, "*batch 3 3"],
) -> Float[Array, "*batch"]:
    r"""Squares of errors in units of what was claimed: $e^\top C^{-1} e$.

    Normalised estimation error squared. If the covariances are honest and the errors
    normal, these are χ² with 3 degrees of freedom: their mean is 3, 95 % of them are
    below 7.81, and the mean of n has a standard error of √(6/n). More: too sure; less:
    too modest.

    Args:
        pose: estimates [m, m, rad].
        reference: true poses in the same frame. If they are uncertain themselves, and
            independently so, add their covariance.
        covariance: of the estimates [m, m, rad]².

    Reference:
        Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to
        Tracking and Navigation", 2001, §5.4.

    Example:
        >>> honest = jnp.diag(jnp.array([0.01, 0.01, 0.0004]))
        >>> round(float(nees(jnp.array([0.1, 0.1, 0.02]), jnp.zeros(3), honest)), 3)
        3.0
    """
    off = pose - reference
    off = off.at[..., 2].set(geometry.wrap(off[..., 2]))
    # In units of each σ, so that metres and radians do not spoil the solution.
    sigma = jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (sigma[..., :, None] * sigma[..., None, :])
    z = off / sigma
    return jnp.sum(z * jnp.linalg.solve(correlation, z[..., None])[..., 0], axis=-1)


def position_rms(covariance: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Root mean square distance [m] that a pose covariance [m, m, rad]² stands for."""
    return jnp.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])
