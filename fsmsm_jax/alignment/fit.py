"""From nearly right to exactly right: robust descent with exact derivatives.

Two residuals serve two purposes. The distance from each *end point* to the nearest
wall has a wide basin: it pulls a guess that is half a metre off onto the walls,
whatever the sensor cannot see. The difference of *ranges*, real against virtual,
knows which wall a ray should meet first and is the sensor's own measurement: near
the truth its Gauss-Newton step is as precise as the physics allows.

Both are iterated as Gauss-Newton steps reweighted by Geman and McClure's kernel,
w = (1 + (e/s)²)⁻², whose scale s shrinks from step to step (graduated
non-convexity): people and moved furniture lose their vote as the pose settles.
Everything is written for one pose; `vmap` refines many candidates at once.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.residuals import (
    gauss_newton_step,
    geman_mcclure,
    range_residuals,
    scale_of,
)
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["descend_end_points", "fit_ranges", "polish_ranges"]

_DAMPING = 1e-2  # share of the rays' weight added to the diagonal of the end-point step
_KERNEL = 4.0  # width of the kernel in standard deviations: hardly felt by noise
_PARALLEL = np.cos(0.05)  # walls seen by neighbouring rays this parallel are one
_TINY = 1e-4  # [m] added to a kernel's width, for scans without any noise


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
    distances = jax.vmap(jax.value_and_grad(world.distance_at))

    def step(pose, scale):
        end = geometry.transform_points(pose, scan.points)
        e, slope = distances(end)
        lever = end - pose[None, :2]
        turn = slope[:, 1] * lever[:, 0] - slope[:, 0] * lever[:, 1]
        J = jnp.concatenate([slope, turn[:, None]], axis=1)
        w = jnp.where(scan.echo, geman_mcclure(e, scale), 0.0)
        return gauss_newton_step(pose, -e, J, w, _DAMPING), None

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
        e, J, known = range_residuals(world, scan, state[:3], state[3])
        w = jnp.where(known, geman_mcclure(e, scale) / J[:, 3] ** 2, 0.0)
        return gauss_newton_step(state, e, J, w, 1e-3), None

    state = jax.lax.scan(step, jnp.append(pose, 0.0), scales)[0]
    return state[:3], state[3]


def fit_ranges(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    steps: int,
    reach: ScalarLike = math.inf,
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
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

    Returns:
        The pose of the lidar in the map, and the thickness of the drawn walls [m],
        nought on polygons.
    """
    drawn_thick = isinstance(world, OccupancyGrid)

    def step(now, _):
        e, J, known = range_residuals(world, scan, now[:3], now[3])
        slant = jnp.maximum(jnp.linalg.norm(J[:, :2], axis=1), 1.0)
        J = J if drawn_thick else J.at[:, 3].set(0.0)
        e = jnp.where(known, e, 0.0)
        rho = _shared_variance(e, J, known)
        weight = 1 / (1 - rho + rho * slant**2)
        scaled = e * jnp.sqrt(weight)
        width = _KERNEL * scale_of(scaled, known) + _TINY
        w = jnp.where(known, geman_mcclure(scaled, width) * weight, 0.0)
        after = gauss_newton_step(now, e, J, w, 1e-6)
        near = jnp.clip(after[:2], pose[:2] - reach, pose[:2] + reach)
        return after.at[:2].set(near), None

    state = jax.lax.scan(step, jnp.append(pose, 0.0), length=steps)[0]
    return state[:3], state[3]


def _shared_variance(e, J, known):
    """Share of the residuals' variance that is equal for neighbours on one wall."""
    normal = J[:, :2] / jnp.maximum(jnp.linalg.norm(J[:, :2], axis=1), 1e-9)[:, None]
    parallel = jnp.sum(normal * jnp.roll(normal, 1, axis=0), axis=1) > _PARALLEL
    pair = known & jnp.roll(known, 1) & parallel
    own = scale_of(e - jnp.roll(e, 1), pair) ** 2 / 2
    total = jnp.maximum(scale_of(e, known) ** 2, 1e-12)
    return jnp.where(jnp.any(pair), jnp.clip(1 - own / total, 0.0, 1.0), 0.0)
