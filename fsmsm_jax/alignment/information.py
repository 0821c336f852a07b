"""How sure a pose is: the information of its ranges, as a covariance.

The exact derivative J of the virtual scan by the pose gives the Fisher information
JᵀJ/σ² of the real one; its inverse, the Cramér–Rao bound, is what an estimate may
reach where errors are independent (A. Censi, ICRA 2007). On maps of real buildings
they are not, and the covariance says so.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fsmsm_jax.alignment.residuals import range_residuals, scale_of
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["covariance"]

_SECTORS = 36  # runs of rays whose errors are taken as shared
_PRIOR_VARIANCE = (10.0**2, 10.0**2, 3.14**2, 0.05**2)  # of what nobody measured


def covariance(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    thickness: float | Float[Array, ""] = 0.0,
    floor: float | Float[Array, ""] = 0.005,
) -> Float[Array, "3 3"]:
    """Covariance of a polished pose [m, m, rad], by the information of its ranges.

    A⁻¹ B A⁻¹, where A = Σ J Jᵀ/σ² is the Fisher information, σ across the wall,
    and B the scatter of the score: residuals are summed over `_SECTORS` runs of
    neighbouring rays before they are squared, so that errors which neighbours share
    (a wall drawn askew, a moved cabinet) count as one error and not as many that
    cancel. Were all errors independent, B = A and the covariance would be the
    Cramér–Rao bound; it is never reported smaller than that. σ is read off the
    residuals (1.48 times their median size, at least `floor` [m]) and rays farther
    off than 3σ are left out. The walls' thickness counts as unknown. A direction
    that no ray measures (along a corridor) keeps a variance of (10 m)² or (π rad)²:
    degeneracy is reported, never hidden.

    Reference:
        A. Censi, "On achievable accuracy for range-finder localization", ICRA 2007;
        the cluster-robust sandwich is K.-Y. Liang and S. Zeger's, Biometrika 1986.
    """
    e, J, known = range_residuals(world, scan, pose, jnp.asarray(thickness))
    e, J = e / J[:, 3], J / J[:, 3:]
    sigma = jnp.maximum(scale_of(e, known), floor)
    used = (known & (jnp.abs(e) < 3 * sigma))[:, None]
    J = jnp.where(used, J / sigma, 0.0)
    prior = jnp.diag(1 / jnp.sqrt(jnp.asarray(_PRIOR_VARIANCE, pose.dtype)))
    # A⁻¹ = H Hᵀ by QR: squaring J first would lose a corridor's direction in float32.
    root = jnp.linalg.qr(jnp.concatenate([J, prior]), mode="r")
    identity = jnp.eye(4, dtype=pose.dtype)
    H = jax.scipy.linalg.solve_triangular(root, identity)
    score = J * jnp.where(used, e[:, None] / sigma, 0.0)
    sector = (jnp.arange(len(e)) * _SECTORS) // len(e)
    score = jax.ops.segment_sum(score, sector, _SECTORS) @ H
    scatter = score.T @ score * _SECTORS / (_SECTORS - 4)
    whole = H @ (identity + _positive_part(scatter - identity)) @ H.T
    return (0.5 * (whole + whole.T))[:3, :3]


def _positive_part(matrix):
    """The symmetric matrix less its negative eigenvalues."""
    value, vector = jnp.linalg.eigh((matrix + matrix.T) / 2)
    return (vector * jnp.maximum(value, 0.0)[None]) @ vector.T
