"""From nearly right to exactly right, and how sure: descent with exact derivatives.

Two residuals serve two purposes. The distance from each *end point* to the nearest
wall has a wide basin: it pulls a guess that is half a metre off onto the walls,
whatever the sensor cannot see. The difference of *ranges*, real against virtual,
knows which wall a ray should meet first and is the sensor's own measurement: near
the truth its Gauss-Newton step is as precise as the physics allows, and its Fisher
information is the Cramér–Rao bound (A. Censi, ICRA 2007).

Both are iterated as Gauss-Newton steps reweighted by Geman and McClure's kernel,
w = (1 + (e/s)²)⁻², whose scale s shrinks from step to step (graduated
non-convexity): people and moved furniture lose their vote as the pose settles.
Everything is written for one pose; `vmap` refines many candidates at once.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fsmsm_jax import geometry
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["covariance", "descend_end_points", "fit_ranges", "polish_ranges"]

_DAMPING = 1e-2  # share of the rays' weight added to the diagonal of the end-point step
_LONGEST_STEP = 0.3  # [m] and [rad] per iteration: the linearisation holds no farther
_STEEPEST = 3.0  # cap of 1/|n·d|: at 70° and more the normal itself is uncertain
_KERNEL = 4.0  # width of the kernel in standard deviations: hardly felt by noise
_PARALLEL = np.cos(0.05)  # walls seen by neighbouring rays this parallel are one
_TINY = 1e-4  # [m] added to a kernel's width, for scans without any noise
_SECTORS = 36  # runs of rays whose errors are taken as shared
_PRIOR_VARIANCE = (10.0**2, 10.0**2, 3.14**2, 0.05**2)  # of what nobody measured


def descend_end_points(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    scales: Float[Array, "steps"],
) -> Float[Array, "3"]:
    """Pull the scan's end points onto the nearest walls.

    Args:
        world: the map.
        scan: the real scan, n rays; only its echoes take part.
        pose: first guess [x, y, θ] of the lidar in the map; half a metre and some ten
            degrees may be missing.
        scales: kernel scale s of each step [m], shrinking; its length is the number
            of steps.

    Returns:
        The refined pose of the lidar in the map.
    """

    def distances(pose):
        return world.distance_at(geometry.transform_points(pose, scan.points))

    def step(pose, scale):
        e, derivative = jax.linearize(distances, pose)
        J = jax.vmap(derivative, out_axes=1)(jnp.eye(3, dtype=pose.dtype))
        w = jnp.where(scan.echo, _geman_mcclure(e, scale), 0.0)
        return _gauss_newton(pose, -e, J, w, _DAMPING), None

    return jax.lax.scan(step, pose, scales)[0]


def polish_ranges(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    scales: Float[Array, "steps"],
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Robust Gauss-Newton on real minus virtual ranges, by the cast's exact derivative.

    A map made from scans draws its walls some centimetres thick, and every virtual
    ray stops at the near face: too early, by b / |n·d|. That would push the pose
    away from whatever the sensor faces, so b is estimated along with the pose
    (centimetres on maps of real buildings, nothing on true ones).

    Args:
        world: the map.
        scan: the real scan, n rays; echoes that the map explains take part.
        pose: guess [x, y, θ] of the lidar in the map, within some centimetres.
        scales: kernel scale s of each step [m]; its length is the number of steps.

    Returns:
        The refined pose of the lidar in the map, and the thickness b [m].
    """

    def step(state, scale):
        e, J, known = _range_residuals(world, scan, state[:3], state[3])
        w = jnp.where(known, _geman_mcclure(e, scale) / J[:, 3] ** 2, 0.0)
        return _gauss_newton(state, e, J, w, 1e-3), None

    state = jax.lax.scan(step, jnp.append(pose, 0.0), scales)[0]
    return state[:3], state[3]


def fit_ranges(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    steps: int,
    reach: float | Float[Array, ""] = math.inf,
) -> Float[Array, "3"]:
    r"""Robust Gauss-Newton on real minus virtual ranges, all noise unknown.

    Two things spoil a residual e. The sensor's noise is the same for every ray and
    new in every ray; a wall that stands elsewhere than drawn is shared by its rays
    and grows with their slant s = 1/|n·d|. So rays are weighted by
    $1/(1 - \rho + \rho s^2)$, with ρ the share of var(e) that neighbouring rays on
    one wall have in common: 0 on a true map, where the fit then reaches the Cramér–Rao
    bound. Both variances are read off the residuals, by medians, in every step. On
    grids the thickness of drawn walls is estimated as well (see `polish_ranges`).

    Args:
        world: the map.
        scan: the real scan, rays in order of bearing; echoes that the map explains
            take part.
        pose: guess [x, y, θ] of the lidar in the map, within some decimetres.
        steps: how often to linearise; static.
        reach: how far from the guess the answer may lie [m], in x and in y. Along a
            narrow gap, walls drawn too close would let the pose slide without end.
    """
    drawn_thick = isinstance(world, OccupancyGrid)

    def step(now, _):
        e, J, known = _range_residuals(world, scan, now[:3], now[3])
        slant = jnp.maximum(jnp.linalg.norm(J[:, :2], axis=1), 1.0)
        J = J if drawn_thick else J.at[:, 3].set(0.0)
        e = jnp.where(known, e, 0.0)
        rho = _shared_variance(e, J, known)
        weight = 1 / (1 - rho + rho * slant**2)
        scaled = e * jnp.sqrt(weight)
        width = _KERNEL * _scale(scaled, known) + _TINY
        w = jnp.where(known, _geman_mcclure(scaled, width) * weight, 0.0)
        after = _gauss_newton(now, e, J, w, 1e-6)
        near = jnp.clip(after[:2], pose[:2] - reach, pose[:2] + reach)
        return after.at[:2].set(near), None

    return jax.lax.scan(step, jnp.append(pose, 0.0), length=steps)[0][:3]


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
    e, J, known = _range_residuals(world, scan, pose, jnp.asarray(thickness))
    e, J = e / J[:, 3], J / J[:, 3:]
    sigma = jnp.maximum(_scale(e, known), floor)
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


def _range_residuals(world, scan, pose, thickness):
    """Real minus virtual ranges, their Jacobian, and which rays both worlds know.

    Columns of the Jacobian: x, y, θ and the walls' thickness, whose entry is 1/|n·d|,
    the length of ∂r/∂(x, y).
    """
    cast = lambda pose: raycast(world, pose, scan.bearings, scan.range_max)
    virtual, derivative = jax.linearize(cast, pose)
    J = jax.vmap(derivative, out_axes=1)(jnp.eye(3, dtype=pose.dtype))
    slant = jnp.clip(jnp.linalg.norm(J[:, :2], axis=1), 1.0, _STEEPEST)
    e = scan.ranges - virtual - thickness * slant
    known = scan.echo & (virtual < scan.range_max)
    return e, jnp.concatenate([J, slant[:, None]], axis=1), known


def _scale(e, known):
    """Standard deviation that the median of |e| stands for; 0 if nothing is known."""
    middle = jnp.nanmedian(jnp.where(known, jnp.abs(e), jnp.nan))
    return jnp.where(jnp.any(known), 1.4826 * middle, 0.0)


def _shared_variance(e, J, known):
    """Share of the residuals' variance that is equal for neighbours on one wall."""
    normal = J[:, :2] / jnp.maximum(jnp.linalg.norm(J[:, :2], axis=1), 1e-9)[:, None]
    parallel = jnp.sum(normal * jnp.roll(normal, 1, axis=0), axis=1) > _PARALLEL
    pair = known & jnp.roll(known, 1) & parallel
    own = _scale(e - jnp.roll(e, 1), pair) ** 2 / 2
    total = jnp.maximum(_scale(e, known) ** 2, 1e-12)
    return jnp.where(jnp.any(pair), jnp.clip(1 - own / total, 0.0, 1.0), 0.0)


def _geman_mcclure(e, scale):
    return 1 / (1 + (e / scale) ** 2) ** 2


def _gauss_newton(state, e, J, w, damping):
    """One weighted least-squares step of e ≈ J δ, damped and of bounded length.

    The state is a pose [x, y, θ], or one with further unknowns behind it.
    """
    information = (J * w[:, None]).T @ J
    damped = information + (damping * jnp.sum(w) + 1e-3) * jnp.eye(len(state))
    step = jnp.linalg.solve(damped, (J * w[:, None]).T @ e)
    state = state + jnp.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
    return state.at[2].set(geometry.wrap(state[2]))
