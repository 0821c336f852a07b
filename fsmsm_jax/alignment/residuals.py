"""Real minus virtual ranges, linearised: what fits and covariances are made of.

e = S_R − S_V(x, y, θ) − b / |n·d| for each ray, with its exact Jacobian. The last term
is the thickness b of the walls as drawn: a map made from scans draws them some
centimetres thick, and every virtual ray stops at the near face, too early by b / |n·d|.
On a true map b is nought.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.raycast import raycast_with_jacobian
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["gauss_newton_step", "geman_mcclure", "range_residuals", "scale_of"]

_LONGEST_STEP = 0.3  # [m] and [rad] per iteration: the linearisation holds no farther
_STEEPEST = 3.0  # cap of 1/|n·d|: at 70° and more the normal itself is uncertain


def range_residuals(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    thickness: ScalarLike = 0.0,
) -> tuple[Float[Array, "rays"], Float[Array, "rays 4"], Bool[Array, "rays"]]:
    """Real minus virtual ranges [m], their Jacobian, and which rays both worlds know.

    Columns of the Jacobian: x, y, θ and the walls' thickness, whose entry is 1/|n·d|,
    the length of ∂r/∂(x, y). Pose [m, m, rad] and thickness [m] as in the module.
    """
    virtual, J = raycast_with_jacobian(world, pose, scan.bearings, scan.range_max)
    slant = jnp.clip(jnp.linalg.norm(J[:, :2], axis=1), 1.0, _STEEPEST)
    e = scan.ranges - virtual - thickness * slant
    known = scan.echo & (virtual < scan.range_max)
    return e, jnp.concatenate([J, slant[:, None]], axis=1), known


def scale_of(e: Float[Array, "rays"], known: Bool[Array, "rays"]) -> Float[Array, ""]:
    """Standard deviation that the median of |e| stands for; 0 if nothing is known.

    The median by bisection, to a millionth of the largest |e|: counting is some ten
    times faster than sorting, and fits ask this in every step.
    """
    size = jnp.where(known, jnp.abs(e), jnp.inf)
    half = 0.5 * jnp.sum(known)

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        enough = jnp.sum(size <= middle) >= half
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    largest = jnp.max(jnp.where(known, size, 0.0))
    _, median = jax.lax.fori_loop(0, 20, halve, (jnp.zeros_like(largest), largest))
    return 1.4826 * median


def geman_mcclure(
    e: Float[Array, "*shape"], scale: ScalarLike
) -> Float[Array, "*shape"]:
    """Weight of a residual in reweighted least squares: 1 at 0, 1/4 at the scale."""
    return 1 / (1 + (e / scale) ** 2) ** 2


def gauss_newton_step(
    state: Float[Array, "unknowns"],
    e: Float[Array, "rays"],
    J: Float[Array, "rays unknowns"],
    w: Float[Array, "rays"],
    damping: ScalarLike,
) -> Float[Array, "unknowns"]:
    """One weighted least-squares step of e ≈ J δ, damped and of bounded length.

    The state is a pose [x, y, θ], or one with further unknowns behind it.
    """
    information = (J * w[:, None]).T @ J
    damped = information + (damping * jnp.sum(w) + 1e-3) * jnp.eye(
        len(state), dtype=state.dtype
    )
    step = _solve(damped, (J * w[:, None]).T @ e)
    state = state + jnp.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
    return state.at[2].set(geometry.wrap(state[2]))


def _solve(A, b):
    """Solution of a small positive definite system A x = b, by Cholesky's L Lᵀ.

    Unrolled, so that a batch of them is a handful of vector operations, where LAPACK
    would be called once for each.
    """
    n = len(b)
    L = [[A[i, j] for j in range(i + 1)] for i in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = A[i, j] - sum(L[i][k] * L[j][k] for k in range(j))
            L[i][j] = jnp.sqrt(rest) if i == j else rest / L[j][j]
    y, x = [b[i] for i in range(n)], [b[i] for i in range(n)]
    for i in range(n):
        y[i] = (b[i] - sum(L[i][k] * y[k] for k in range(i))) / L[i][i]
    for i in reversed(range(n)):
        x[i] = (y[i] - sum(L[k][i] * x[k] for k in range(i + 1, n))) / L[i][i]
    return jnp.stack(x)
