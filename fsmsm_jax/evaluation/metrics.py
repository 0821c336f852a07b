"""How far off a pose is, whether that counts as right, and what was possible at all.

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
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["cramer_rao_bound", "pose_errors", "position_rms", "success"]

_KNOWN_BEFORE = (10.0, 10.0, math.pi)  # [m, m, rad] 1σ of what no ray measures


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


def cramer_rao_bound(
    world: OccupancyGrid | PolygonMap,
    pose: Float[Array, "3"],
    bearings: Float[Array, "rays"],
    range_max: float | Float[Array, ""],
    sigma: float | Float[Array, ""],
) -> Float[Array, "3 3"]:
    r"""Smallest covariance [m, m, rad]² that an unbiased estimate of the pose can have.

    With $J = \partial r / \partial (x, y, \theta)$ the exact derivative of the ray
    cast, $\Sigma \ge (J^\top J / \sigma^2)^{-1}$ for independent Gaussian noise.

    Args:
        world: the map, taken to be true.
        pose: where the scan is taken [m, m, rad].
        bearings: directions of the rays in the sensor frame [rad].
        range_max: rays that meet nothing nearer [m] carry no information.
        sigma: standard deviation of a range [m].

    Returns:
        The bound. A direction that no ray measures keeps (10 m)² or (π rad)².

    Reference:
        A. Censi, "On achievable accuracy for range-finder localization", ICRA 2007.

    Note:
        Rays within 6° of a wall count as if at 6° (see `sensing.raycast`). The factor
        J = QR is inverted, not JᵀJ, whose condition is squared: float32 suffices even
        in a corridor. For many poses, `vmap`.
    """
    cast = lambda pose: raycast(world, pose, bearings, range_max)
    _, derivative = jax.linearize(cast, pose)
    J = jax.vmap(derivative, out_axes=1)(jnp.eye(3, dtype=pose.dtype))
    known_before = jnp.diag(1 / jnp.asarray(_KNOWN_BEFORE, pose.dtype))
    R = jnp.linalg.qr(jnp.concatenate([J / sigma, known_before]), mode="r")
    root = jnp.linalg.inv(R)
    return root @ root.T


def position_rms(covariance: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Root mean square distance [m] that a pose covariance [m, m, rad]² stands for."""
    return jnp.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])
