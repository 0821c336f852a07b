r"""Two scans fitted to each other, neither of them the truth.

In a map the walls are exact and a virtual scan can be differenced from the real one.
Here the walls are another scan's end points, as noisy as the rays that are held against
them. So nothing is cast. An end point p of one scan, moved into the other's frame, lies
along some bearing φ between two of its rays, and is off by

$$e = r(\varphi(p)) - |p|,$$

with r the measured ranges, interpolated. Both noises enter linearly, so they average
out. Only the derivative, $\partial e / \partial p = r' \hat\varphi / |p| - \hat p$,
needs to know which way the wall faces, and takes that from `sensing.surfaces`. Each of
the two scans is laid upon the other in turn, and all residuals share one robust
Gauss-Newton step: an interpolated ray has less noise than a measured one, so that two
half views of one thing are better than one.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.information import definite, inverse_root
from fsmsm_jax.alignment.residuals import gauss_newton_step, geman_mcclure, scale_of
from fsmsm_jax.sensing import Scan, Surfaces, panorama, surfaces

__all__ = ["View", "fit_views", "view_covariance", "view_residuals"]

_KERNEL = 4.0  # width of the kernel in standard deviations, as in `fit_ranges`
_TINY = 1e-4  # [m] added to it, for scans without any noise
_FARTHEST = 1e-4  # [1/m] least inverse range between two rays
# A point between two rays has, on average, two thirds of a ray's variance: residuals
# show 1 + 2/3 of it where two scans have 2.
_INTERPOLATED = 2 / (1 + 2 / 3)
_MERE_NOISE = 3.0  # times the information that noise alone would feign is taken off
_LEAST = 1e-4  # of the information is left, if noise might be all of it
_SLOPES = 1.45  # variance over that of a fit with exact slopes, at all levels of noise
_FLOOR = 0.005  # [m] least noise of a range that a covariance believes in


class View(NamedTuple):
    """A scan, made ready to be laid upon another."""

    scan: Scan
    """As it was measured: what is laid upon the other."""
    panorama: Scan
    """The same as N equiangular rays: what the other is laid upon."""
    walls: Surfaces
    """The walls behind them."""

    @classmethod
    def of(cls, scan: Scan, rays: int) -> "View":
        """From any scan; `rays` is static."""
        around = panorama(scan, rays)
        return cls(scan, around, surfaces(around))


def view_residuals(
    reference: View, scan: Scan, pose: Float[Array, "3"]
) -> tuple[
    Float[Array, "rays"],
    Float[Array, "rays 3"],
    Float[Array, "rays 3"],
    Bool[Array, "rays"],
]:
    """How far the scan's end points are from the reference's walls, along its rays.

    Args:
        reference: the scan that is laid upon.
        scan: the scan whose end points are laid upon it.
        pose: of the scan's sensor in the frame of the reference's [m, m, rad].

    Returns:
        Residuals e [m]; J = −∂e/∂(x, y, θ); how far J is off if the wall's slope is by
        one standard deviation; which end points lie where the reference saw a wall.
    """
    ranges, walls = reference.panorama.ranges, reference.walls
    rays = ranges.size
    spacing = 2 * np.pi / rays
    p = geometry.transform_points(pose, scan.points)
    x, y = p[:, 0], p[:, 1]
    away = jnp.maximum(jnp.hypot(x, y), _TINY)
    place = (jnp.arctan2(y, x) + jnp.pi) / spacing
    before = jnp.floor(place)
    t = place - before
    before = before.astype(int) % rays
    after = (before + 1) % rays
    mixed = lambda f, one, other: one * f[before] + other * f[after]

    # Between two rays runs the chord: 1/r is a sum of sines, as for any straight wall.
    near, far = jnp.sin((1 - t) * spacing), jnp.sin(t * spacing)
    inverse = mixed(1 / jnp.maximum(ranges, _TINY), near, far) / math.sin(spacing)
    e = 1 / jnp.maximum(inverse, _FARTHEST) - away

    bend = mixed(walls.slope / jnp.maximum(walls.ranges, _TINY), 1 - t, t)
    unsure = walls.noise * jnp.sqrt(walls.slope_share[before]) / away
    ux, uy = x / away, y / away
    rx, ry = x - pose[0], y - pose[1]
    row = lambda gx, gy: jnp.stack([gx, gy, gy * rx - gx * ry], axis=-1)
    J, doubt = row(ux + bend * uy, uy - bend * ux), row(unsure * uy, -unsure * ux)
    return e, J, doubt, scan.echo & walls.solid[before]


def fit_views(
    reference: View,
    view: View,
    pose: Float[Array, "3"],
    steps: int,
    reach: ScalarLike = jnp.inf,
) -> Float[Array, "3"]:
    """Robust Gauss-Newton on both scans' end points; the noise is read off them.

    Args:
        reference: one scan.
        view: the other.
        pose: guess of the sensor of `view` in the frame of the reference's
            [m, m, rad], within some centimetres.
        steps: how often to linearise; static.
        reach: how far from the guess the answer may lie [m], in x and in y.

    Returns:
        The pose, refined.
    """

    def step(now, _):
        e, J, _, w = _weighed(reference, view, now)
        after = gauss_newton_step(now, e, J, w, 1e-6)
        near = jnp.clip(after[:2], pose[:2] - reach, pose[:2] + reach)
        return after.at[:2].set(near), None

    return jax.lax.scan(step, pose, length=steps)[0]


def _weighed(reference, view, pose):
    """Residuals of each scan on the other, and how much each of them counts."""
    back = geometry.inverse(pose)
    one = view_residuals(reference, view.scan, pose)
    other = view_residuals(view, reference.scan, back)
    by_pose = jax.jacfwd(geometry.inverse)(pose)
    e, known = (jnp.concatenate([one[k], other[k]]) for k in (0, 3))
    J, doubt = (jnp.concatenate([one[k], other[k] @ by_pose]) for k in (1, 2))
    e = jnp.where(known, e, 0.0)
    width = _KERNEL * scale_of(e, known) + _TINY
    return e, J, doubt, jnp.where(known, geman_mcclure(e, width), 0.0)


def view_covariance(
    reference: View, view: View, pose: Float[Array, "3"]
) -> Float[Array, "3 3"]:
    r"""Covariance [m, m, rad]² of a pose that was fitted by `fit_views`.

    $2 v (J^\top W J)^{-1}$ over the residuals of both directions, which are two looks
    at the same noise: hence the 2. v is the variance of both scans' noise together,
    as the residuals show it, made up for the part of it that interpolation removes. The
    walls' slopes are estimates, too, and edges belong to no wall: on the worlds of the
    thesis the poses scatter by 1.45 times that variance, for every noise from 0.01 to
    0.2 m, and the covariance is larger by as much. In a direction that nothing measures
    noise of the slopes looks like information; three times of what is expected of it is
    taken off: slopes of neighbours err alike.

    Returns:
        The covariance, positive definite. What no ray measures has (10 m)² or (π rad)².
    """
    e, J, doubt, w = _weighed(reference, view, pose)
    v = jnp.sum(w**2 * e**2) / jnp.maximum(jnp.sum(w**2), 1e-6)
    v = _SLOPES * jnp.maximum(v * _INTERPOLATED, 2 * _FLOOR**2)
    count = jnp.sqrt(w / (2 * v))[:, None]
    H, _ = inverse_root(J * count)
    feigned = doubt * count @ H
    left, axes = jnp.linalg.eigh(
        jnp.eye(3, dtype=H.dtype) - _MERE_NOISE * feigned.T @ feigned
    )
    H = H @ axes / jnp.sqrt(jnp.maximum(left, _LEAST))[None]
    return definite(H @ H.T)
