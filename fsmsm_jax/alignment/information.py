"""How sure a pose is: the information of its ranges, as a covariance.

The exact derivative J of the virtual scan by the pose gives the Fisher information
JᵀJ/σ² of the real one; its inverse, the Cramér–Rao bound, is what an estimate may
reach where errors are independent. Maps of real buildings are not so kind: a wall that
stands 2 cm from where it is drawn deceives a hundred rays at once, and all the rays of
the world would not average it away. `covariance` looks whether neighbouring residuals
take the same side more often than a coin would. If not, it is the bound, for the noise
that the residuals show. If so, it takes the map for a rubber sheet whose displacement
is shared by what stands within a metre, and asks how far such a sheet drags the pose.

A direction that nothing measures, such as the way along a corridor, has a standard
deviation of 10 m, not none; `degenerate_directions` tells which those are.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax.alignment.residuals import geman_mcclure, range_residuals, scale_of
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.raycast import raycast_with_jacobian
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "Directions",
    "covariance",
    "covariance_root",
    "cramer_rao_bound",
    "definite",
    "degenerate_directions",
    "fisher_information",
    "inverse_root",
]

_UNMEASURED = (10.0, 10.0, math.pi, 0.05)  # [m, m, rad, m] 1σ of what no ray measures
_KERNEL = 4.0  # width of the fit's kernel in standard deviations, as in `fit_ranges`
_MOST_RESTING = 0.5  # of a direction, on one ray
_SHEET = 1.0  # [m] to which errors of a map extend: what a wall or a cabinet measures
_RUNS = 60  # runs of neighbouring rays whose share of an error is reckoned together
_MOST_TAKEN = 0.75  # of the errors, by the pose: residuals tell no more of it
_ROUNDING = 0.1  # times the floor: residuals as small are of computing, not measuring
_ROUNDING_OF_ONE = 1e-6  # float32's, some ten times over: 1 cm beside 10 m
_COIN = 2.0  # standard errors above chance from which neighbours count as agreeing


def fisher_information(
    world: OccupancyGrid | PolygonMap,
    pose: Float[Array, "3"],
    bearings: Float[Array, "rays"],
    range_max: float | Float[Array, ""],
    sigma: float | Float[Array, ""],
) -> Float[Array, "3 3"]:
    r"""What the ranges of a scan tell about the pose it is taken from, [m, m, rad]⁻².

    $J^\top J / \sigma^2$, with $J = \partial r / \partial (x, y, \theta)$ the exact
    derivative of the ray cast, for independent Gaussian noise. Additive: two scans
    from one pose tell the sum. Singular where a direction is not measured.

    Args:
        world: the map, taken to be true.
        pose: where the scan is taken [m, m, rad].
        bearings: directions of the rays in the sensor frame [rad].
        range_max: rays that meet nothing nearer [m] carry no information.
        sigma: standard deviation of a range [m].

    Reference:
        A. Censi, "On achievable accuracy for range-finder localization", ICRA 2007.
    """
    _, J = raycast_with_jacobian(world, pose, bearings, range_max)
    return J.T @ J / sigma**2


def cramer_rao_bound(
    world: OccupancyGrid | PolygonMap,
    pose: Float[Array, "3"],
    bearings: Float[Array, "rays"],
    range_max: float | Float[Array, ""],
    sigma: float | Float[Array, ""],
) -> Float[Array, "3 3"]:
    r"""Smallest covariance [m, m, rad]² that an unbiased estimate of the pose can have.

    The inverse of `fisher_information`, whose arguments it takes; a direction that
    no ray measures keeps (10 m)² or (π rad)².

    Note:
        Rays within 6° of a wall count as if at 6° (see `sensing.raycast`). The factor
        J = QR is inverted, not JᵀJ, whose condition is squared: float32 suffices even
        in a corridor. For many poses, `vmap`.
    """
    _, J = raycast_with_jacobian(world, pose, bearings, range_max)
    H, _ = inverse_root(J / sigma)
    return H @ H.T


def inverse_root(
    J: Float[Array, "rays unknowns"],
) -> tuple[Float[Array, "unknowns unknowns"], Float[Array, "unknowns unknowns"]]:
    """H with H Hᵀ = (JᵀJ + P)⁻¹, by QR, and the root of P, what is known without J."""
    unknowns = J.shape[1]
    known_before = jnp.diag(1 / jnp.asarray(_UNMEASURED[:unknowns], J.dtype))
    root = jnp.linalg.qr(jnp.concatenate([J, known_before]), mode="r")
    identity = jnp.eye(unknowns, dtype=J.dtype)
    return jax.scipy.linalg.solve_triangular(root, identity), known_before


def covariance(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    thickness: float | Float[Array, ""] = 0.0,
    floor: float | Float[Array, ""] = 0.005,
) -> Float[Array, "3 3"]:
    r"""Covariance [m, m, rad]² of a pose that was fitted to the scan's ranges.

    The fit turns errors e of the ranges into an error of the pose of
    $A^{-1} \sum_i w_i J_i e_i$, with its weights w (`fit_ranges`) and
    $A = \sum_i w_i J_i J_i^\top$. A range has two errors, of variances (1 − ρ) v and
    ρ v / |n·d|². One is its own. The other is n·u / |n·d|, where u is how far the wall
    that it meets at p stands from where it is drawn:
    $\mathrm{E}\, u(p) u(q)^\top = ρ v \exp(-|p - q|^2 / 2 ℓ^2) I$ with ℓ = 1 m. v is
    the variance of the residuals, made up for what the pose took of them (as n/(n − 4)
    does where errors are independent), and ρ how much of it neighbouring rays share.

    On a true map ρ is nought, and this is the Cramér–Rao bound over the fit's
    efficiency (0.96), and a little more where few rays decide: each ray's own error is
    counted as the jackknife would, e / (1 − leverage). ρ comes from the share of
    neighbours whose residuals have the same sign, and counts only if two standard
    errors above a coin's. ℓ is stated, not estimated: the pose gives way to errors that
    extend over the room, so that residuals do not show them. It was chosen on maps of
    four buildings.

    Args:
        world: the map.
        scan: the real scan, rays in order of bearing.
        pose: of the lidar in the map, as fitted to this scan.
        thickness: of the walls as drawn [m], as fitted; on a grid it counts as unknown.
        floor: smallest standard deviation of a range [m].

    Returns:
        The covariance, positive definite. What no ray measures has (10 m)² or (π rad)².

    Reference:
        Weighted sandwich: P. Huber, "Robust Statistics", 1981, §6; leverage: HC3 of
        J. MacKinnon and H. White, 1985. Model of the map's errors: ours.

    Note:
        As the fit, it knows one valley: of another one that the pose might be in, it
        says nothing. On a CPU it takes as long as some three casts.
    """
    L = covariance_root(world, scan, pose, thickness, floor)
    return definite(L @ L.T)


def covariance_root(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    thickness: float | Float[Array, ""] = 0.0,
    floor: float | Float[Array, ""] = 0.005,
) -> Float[Array, "3 3"]:
    """Lower triangular L with L Lᵀ = `covariance`, whose arguments it takes.

    In a corridor that runs at a slant, (10 m)² along it share an entry with (1 mm)²
    across, of which float32 keeps nothing; of L it keeps both. What fuses a scan with
    another opinion asks for this one.
    """
    thickness = jnp.asarray(thickness, pose.dtype)
    e, J, known = range_residuals(world, scan, pose, thickness)
    ahead = jnp.stack([jnp.cos(scan.bearings), jnp.sin(scan.bearings)], axis=-1)
    points = (scan.ranges - e - thickness * J[:, 3])[:, None] * ahead
    if isinstance(world, PolygonMap):
        J = J.at[:, 3].set(0.0)

    # As in the fit: residuals of equal variance, their weights, and the kernel's slope.
    slant = jnp.maximum(jnp.linalg.norm(J[:, :2], axis=1), 1.0)
    rho = _shared(e, known & (jnp.abs(e) > _ROUNDING * floor))
    stretch = jnp.sqrt(1 - rho + rho * slant**2)
    e = jnp.where(known, e / stretch, 0.0)
    width = _KERNEL * jnp.maximum(scale_of(e, known), floor)
    vote = jnp.where(known, geman_mcclure(e, width), 0.0)
    t2 = (e / width) ** 2
    slope = jnp.sum(jnp.where(known, (1 - 3 * t2) / (1 + t2) ** 3, 0.0))
    slope = jnp.maximum(slope / jnp.maximum(jnp.sum(vote), 1e-6), 0.5)
    v = jnp.sum(vote**2 * e**2) / jnp.maximum(jnp.sum(vote**2), 1e-6)
    v = jnp.maximum(v, floor**2)

    # A⁻¹ = H Hᵀ; the scatter of the score is reckoned in H's coordinates, near I.
    rows = jnp.sqrt(vote * slope / v)[:, None] / stretch[:, None] * J
    H, known_before = inverse_root(rows)
    score = (rows @ H) * jnp.sqrt(vote / slope)[:, None] / stretch[:, None]
    prior = known_before @ H
    # A ray on which much of the pose rests may be wrong in its derivative as well:
    # counted as the jackknife does, by what leaving it out would change.
    lever = slope * jnp.sum((rows @ H) ** 2, axis=1, keepdims=True)
    alone = score / (1 - jnp.minimum(lever, _MOST_RESTING))
    own = (1 - rho) * alone.T @ alone
    pull = jnp.concatenate([score * J[:, :1], score * J[:, 1:2]], axis=1)
    scatter = own + rho * _dragged(pull, points, known)
    # The pose took its part of the errors: n / (n − unknowns), for shared errors too.
    taken = slope * jnp.trace(scatter) / jnp.maximum(jnp.sum(vote), 1e-6)
    scatter = scatter / (1 - jnp.minimum(taken, _MOST_TAKEN))
    share, axes = jnp.linalg.eigh(prior.T @ prior + scatter)
    root = H[:3] @ axes * jnp.sqrt(jnp.maximum(share, 0.0))[None]
    return jnp.linalg.qr(root.T, mode="r").T


def definite(covariance: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """A covariance; if rounding has spoilt it, with variances that survive it."""
    sound = jnp.all(jnp.isfinite(jnp.linalg.cholesky(covariance)))
    sigma = jnp.sqrt(jnp.abs(jnp.diagonal(covariance)))[:, None]
    share, axes = jnp.linalg.eigh(covariance / (sigma * sigma.T))
    root = sigma * axes * jnp.sqrt(jnp.maximum(share, _ROUNDING_OF_ONE))[None]
    return jnp.where(sound, covariance, root @ root.T)


def _shared(e, known):
    """Correlation of neighbouring residuals, if it is beyond chance; else 0.

    Of two normal numbers with correlation ρ, the signs agree with probability
    1/2 + asin(ρ)/π: a count that no outlier can spoil.
    """
    pair = known & jnp.roll(known, 1)
    count = jnp.maximum(jnp.sum(pair), 1)
    agree = jnp.sum(jnp.where(pair, jnp.sign(e * jnp.roll(e, 1)), 0.0)) / count
    beyond_chance = agree > _COIN / jnp.sqrt(count)
    return jnp.where(beyond_chance, jnp.sin(0.5 * jnp.pi * agree), 0.0)


def _dragged(pull, points, known):
    """Scatter of Σ pull · u, u being the displacement of a sheet of unit variance."""
    rays = len(points)
    runs = min(_RUNS, rays)
    run = (np.arange(rays) * runs) // rays
    total = lambda a: jax.ops.segment_sum(a, run, runs)
    weight = known.astype(points.dtype)[:, None]
    middle = total(weight * points) / jnp.maximum(total(weight), 1.0)
    apart = jnp.sum((middle[:, None] - middle[None]) ** 2, axis=-1)
    alike = jnp.exp(-0.5 * apart / _SHEET**2)
    x, y = jnp.split(total(pull), 2, axis=1)
    return x.T @ alike @ x + y.T @ alike @ y


class Directions(NamedTuple):
    """The principal axes of a pose covariance, the least known first."""

    axes: Float[Array, "3 3"]
    """Row k: the k-th change of the pose [m, m, rad], of length 1 m once its angle is
    counted as an arc."""
    sigma: Float[Array, "3"]
    """Standard deviation along each [m], the angle counted as an arc."""
    degenerate: Bool[Array, "3"]
    """Whether the scan leaves that direction open."""


def degenerate_directions(
    covariance: Float[Array, "3 3"],
    limit: float | Float[Array, ""] = 1.0,
    radius: float | Float[Array, ""] = 1.0,
) -> Directions:
    """Along what, if anything, is the pose unknown?

    Args:
        covariance: of a pose [m, m, rad]², as `covariance` gives it.
        limit: a direction with a larger standard deviation than this [m] is
            degenerate. Measured ones have millimetres or centimetres, others 3 to 10 m.
        radius: angles count as arcs of this radius [m]; how far off things are that
            the heading should point at.

    Example:
        >>> lost = degenerate_directions(jnp.diag(jnp.array([100.0, 1e-4, 1e-6])))
        >>> lost.degenerate.tolist(), round(float(lost.sigma[0]), 3)
        ([True, False, False], 10.0)
        >>> jnp.abs(lost.axes[0]).round(3).tolist()  # along x
        [1.0, 0.0, 0.0]

    Note:
        Float32 leaves the standard deviations of the others uncertain by some tenths
        of a millimetre beside one of 10 m.
    """
    arc = jnp.stack([jnp.ones(()), jnp.ones(()), jnp.asarray(radius, float)])
    arc = arc.astype(covariance.dtype)
    variance, axes = jnp.linalg.eigh(covariance * arc[:, None] * arc[None])
    sigma = jnp.sqrt(jnp.maximum(variance[::-1], 0.0))
    return Directions(axes.T[::-1] / arc[None], sigma, sigma > limit)
