r"""Many poses and one unknown: least squares in which every pose looks after itself.

A calibration asks what all scans have in common: where the lidar sits, how long the
map's metre is, how much every range is off. None of it is known apart from the poses,
but the poses know nothing of each other except through it. So the Jacobian is a
column of blocks, one a pose, and a QR decomposition of each block [J_pose J_shared e]
takes the pose out (variable projection, in square-root form):

$$Q^T [J_p \; J_s \; e] = \begin{bmatrix} R_p & R_{ps} & c_p \\ & R_s & c_s
  \end{bmatrix}.$$

The rows of R_s say what this pose's rays know of the shared unknown once the pose has
had its way. Stacked over the poses they give its Gauss-Newton step and its covariance;
R_p δ_p = c_p − R_ps δ_s then moves the pose. No matrix is squared, so float32 is
enough, and the cost grows with the number of scans and no faster.

Residuals are reweighted by Geman and McClure's kernel, four standard deviations wide,
and that deviation is read off the residuals of the step before: a map that explains
little at first is followed loosely, and tightly when it explains much.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.residuals import geman_mcclure, scale_of

__all__ = ["Linearised", "Solution", "solve"]

_KERNEL = 4.0  # width of the kernel in standard deviations: hardly felt by noise
_SMALLEST = 1e-3  # [m] of standard deviation: float32 knows a range no better
_LOOSE = 1.0  # [m] and [rad] by which a pose may move in one step
_SETTLED = 0.2  # a last step this small, in standard deviations, is none


class Linearised(NamedTuple):
    """Residuals about one pose, and what moves them: e ≈ J δ."""

    e: Float[Array, "rows"]
    """What was measured less what was to be expected [m]."""
    J: Float[Array, "rows unknowns"]
    """Derivative of the expected by the pose (three columns) and the shared unknown."""
    known: Bool[Array, "rows"]
    """The rows that count."""


class Solution(NamedTuple):
    """The shared unknown, and what had to be found along with it."""

    shared: Float[Array, "shared"]
    """The estimate."""
    poses: Float[Array, "poses 3"]
    """The poses that go with it [m, m, rad]."""
    covariance: Float[Array, "shared shared"]
    """Sandwich over the poses, never smaller than the inverse information."""
    sigma: Float[Array, ""]
    """Standard deviation of the residuals, by their median [m]."""
    converged: Bool[Array, ""]
    """Whether the last step was small against the standard deviations."""


def solve(
    linearise: Callable[..., Linearised],
    items: PyTree,
    poses: Float[Array, "poses 3"],
    shared: Float[Array, "shared"],
    spread: Float[Array, "shared"],
    sigma: ScalarLike,
    steps: int,
    pose_spread: ScalarLike | Float[Array, "3"] = jnp.inf,
) -> Solution:
    """Robust Gauss-Newton over all poses and the shared unknown.

    Args:
        linearise: `linearise(item, pose, shared)` for one pose.
        items: what belongs to each pose, a pytree with leading axis `poses`.
        poses: first guesses [x, y, θ] [m, m, rad].
        shared: first guess of the shared unknown.
        spread: standard deviation of that guess, a component each. It bounds a step,
            and what the residuals do not tell keeps it as its deviation; 0 is known.
        sigma: standard deviation of the residuals to begin with [m].
        steps: how often to linearise; static.
        pose_spread: standard deviation of the poses as given [m, m, rad].

    Reference:
        Variable projection: G. Golub and V. Pereyra, SIAM J. Numer. Anal. 1973; the
        cluster-robust sandwich is K.-Y. Liang and S. Zeger's, Biometrika 1986.
    """
    count, given, guess = shared.size, poses, shared
    spread = jnp.maximum(spread, _SMALLEST**2)
    weight = jnp.broadcast_to(1 / jnp.asarray(pose_spread, poses.dtype), 3)

    def triangle(args, shared, sigma):
        """One pose's rows, reduced to a square; and its residuals."""
        item, pose, given = args
        e, J, known = linearise(item, pose, shared)
        w = jnp.sqrt(geman_mcclure(e, _KERNEL * sigma)) / sigma
        rows = jnp.concatenate([J, e[:, None]], axis=1)
        rows = jnp.where(known[:, None], rows * w[:, None], 0.0)
        off = (given - pose).at[2].set(geometry.wrap(given[2] - pose[2]))
        prior = jnp.zeros((3, 4 + count)).at[:, :3].set(jnp.diag(weight))
        prior = prior.at[:, -1].set(off * weight)
        # A pose without any rays shall not divide by nought.
        damping = jnp.eye(3, 4 + count) / _LOOSE
        rows = jnp.concatenate([rows, prior, damping])
        return jnp.linalg.qr(rows, mode="r")[: 3 + count], e, known

    def step(state, _):
        shared, poses, sigma, *_ = state
        one = lambda args: triangle(args, shared, sigma)
        R, e, known = jax.lax.map(one, (items, poses, given))
        prior = jnp.column_stack([jnp.diag(1 / spread), (guess - shared) / spread])
        rows = jnp.concatenate([R[:, 3:, 3:].reshape(-1, count + 1), prior])
        A = jnp.linalg.qr(rows, mode="r")[:count]
        move = jax.scipy.linalg.solve_triangular(A[:, :-1], A[:, -1])
        move = jnp.clip(move, -spread, spread)
        rest = R[:, :3, -1] - R[:, :3, 3:-1] @ move
        moves = jax.vmap(jax.scipy.linalg.solve_triangular)(R[:, :3, :3], rest)
        poses = poses + jnp.clip(moves, -_LOOSE, _LOOSE)
        poses = poses.at[:, 2].set(geometry.wrap(poses[:, 2]))
        now = scale_of(e.reshape(-1), known.reshape(-1))
        return (shared + move, poses, jnp.maximum(now, _SMALLEST), R, A, move), None

    state = (shared, poses, jnp.asarray(sigma, poses.dtype))
    R = jnp.zeros((len(poses), 3 + count, 4 + count), poses.dtype)
    state = (*state, R, R[0, 3:, 3:], shared)
    (shared, poses, sigma, R, A, move), _ = jax.lax.scan(step, state, length=steps)
    covariance = _sandwich(A[:, :-1], R[:, 3:, 3:])
    deviation = jnp.sqrt(jnp.diag(covariance))
    settled = jnp.all(jnp.abs(move) <= _SETTLED * deviation)
    return Solution(shared, poses, covariance, sigma, settled)


def _sandwich(A, triangles):
    """(AᵀA)⁻¹ B (AᵀA)⁻¹ with B the scatter of the poses' scores, at least AᵀA."""
    poses, count = len(triangles), len(A)
    H = jax.scipy.linalg.solve_triangular(A, jnp.eye(count, dtype=A.dtype))
    score = jnp.einsum("prs,pr->ps", triangles[:, :, :-1], triangles[:, :, -1]) @ H
    scatter = score.T @ score * poses / max(poses - count, 1)
    value, vector = jnp.linalg.eigh(scatter)
    whole = (H @ vector) * jnp.sqrt(jnp.maximum(value, 1.0))[None]
    return whole @ whole.T
