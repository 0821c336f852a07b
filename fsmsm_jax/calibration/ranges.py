r"""What is wrong with the ranges themselves: a bias, a scale, and noise.

Cheap sensors read some centimetres too much or some percent too little. With true range
$a + b r$ for a reading r, the reading to be expected is (virtual − a) / b, which is
fitted to all scans at once, each at a pose of its own: a bias makes every room too
narrow or too wide, wherever in it one believes to stand.

Two things look alike and cannot be told apart. On a grid, walls drawn 4 cm too thick
are a bias of 4 cm; and a sensor whose metre is wrong is a map whose metre is
(`map_frame`). Trust the map, or trust the sensor.

The noise σ is what is left. Fitting a pose to a scan takes three degrees of freedom
from its rays, four on grids where `fit_ranges` also fits the walls' thickness. And
people, glass and corners are no noise: a ray is either Gaussian or anything between 0
and `range_max`, and expectation-maximisation finds σ and the share of both.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.residuals import range_residuals, scale_of
from fsmsm_jax.calibration.inputs import across_walls, check, determined, thinned
from fsmsm_jax.calibration.separable import Linearised, solve
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Noise", "RangeCorrection", "noise", "range_correction"]

_SPREAD = (0.5, 0.2)  # of the bias [m] and of the scale [share]
_SIGMA = 0.1  # [m] of a residual while the ranges are still wrong
_FIT = 8  # range fits of a pose
_ROUNDS = 60  # of expectation and maximisation
_SMALLEST = 1e-4  # [m] of noise: float32 knows a range of some metres no better


class RangeCorrection(NamedTuple):
    """True range = bias + scale · reading."""

    bias: Float[Array, ""]
    """a, the true range of a reading of 0 [m]."""
    scale: Float[Array, ""]
    """b, true metres to a metre read."""
    covariance: Float[Array, "2 2"]
    """Of [bias, scale], over the scans."""
    std: Float[Array, "2"]
    """Its standard deviations [m, share]."""
    determined: Bool[Array, "2"]
    """Whether the scans tell them. Where all walls are equally far, they do not."""
    poses: Float[Array, "scans 3"]
    """The poses that go with it [m, m, rad]."""
    residual: Float[Array, ""]
    """Standard deviation of a reading's residual, by the median [m]."""
    converged: Bool[Array, ""]
    """Whether the last step was small, against the deviations."""


class Noise(NamedTuple):
    """How much a range varies."""

    sigma: Float[Array, ""]
    """Standard deviation of a range [m]; on a grid, of its cells as well."""
    std: Float[Array, ""]
    """Standard deviation of that estimate [m]."""
    outliers: Float[Array, ""]
    """Share of echoes that are no measurement of the map."""
    poses: Float[Array, "scans 3"]
    """The poses fitted along [m, m, rad]."""
    converged: Bool[Array, ""]
    """Whether the last round changed nothing to speak of."""


def range_correction(
    world: OccupancyGrid | PolygonMap,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    *,
    rays: int = 180,
    steps: int = 12,
) -> RangeCorrection:
    """Bias and scale of a sensor's ranges, jointly with the poses of its scans.

    Args:
        world: the map, taken as true.
        scans: at least 3 scans, stacked along a leading axis.
        poses: (scans, 3) first guesses of the lidar's poses in the map [m, m, rad],
            within some decimetres; they are free.
        rays: about how many rays of a scan to use.
        steps: Gauss-Newton steps.

    Raises:
        ValueError: the scans are not stacked, are fewer than 3, or one has fewer than
            10 echoes; the poses are of a wrong shape or not finite.

    Note:
        On a grid the bias is that of the sensor less the thickness of drawn walls.
        Not differentiable.
    """
    poses = check(scans, poses, 3)
    return _range_correction(world, thinned(scans, rays), poses, steps)


@eqx.filter_jit
def _range_correction(world, scans, poses, steps):
    def linearise(scan, pose, shared):
        bias, scale = shared
        (e, J, known), slant = across_walls(world, scan, pose)
        virtual = scan.ranges - e
        expected = (virtual - bias) / scale
        J = jnp.column_stack([J, -jnp.ones_like(e), -expected]) / scale
        return Linearised((scan.ranges - expected) / slant, J / slant[:, None], known)

    first = jnp.array([0.0, 1.0], poses.dtype)
    spread = jnp.asarray(_SPREAD, poses.dtype)
    found = solve(linearise, scans, poses, first, spread, _SIGMA, steps)
    return RangeCorrection(
        bias=found.shared[0],
        scale=found.shared[1],
        covariance=found.covariance,
        std=jnp.sqrt(jnp.diag(found.covariance)),
        determined=determined(found.covariance, spread),
        poses=found.poses,
        residual=found.sigma,
        converged=found.converged,
    )


def noise(
    world: OccupancyGrid | PolygonMap,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
) -> Noise:
    """Standard deviation of a sensor's ranges, by maximum likelihood.

    Args:
        world: the map, taken as true.
        scans: at least 3 scans, stacked along a leading axis.
        poses: (scans, 3) first guesses of the lidar's poses in the map [m, m, rad],
            within some decimetres.

    Raises:
        ValueError: as `range_correction`.

    Reference:
        EM: A. Dempster, N. Laird and D. Rubin, J. R. Statist. Soc. B 1977; Gaussian
        and uniform range errors: S. Thrun, W. Burgard and D. Fox, Probabilistic
        Robotics, section 6.3.

    Note:
        Not differentiable.
    """
    return _noise(world, scans, check(scans, poses, 3))


@eqx.filter_jit
def _noise(world, scans, poses):
    def one(args):
        scan, pose = args
        pose, thickness = fit_ranges(world, scan, pose, _FIT)
        e, _, known = range_residuals(world, scan, pose, thickness)
        return pose, e, known

    poses, e, known = jax.lax.map(one, (scans, poses))
    freedom = (4 if isinstance(world, OccupancyGrid) else 3) * len(poses)
    anything = 1 / scans.range_max[:, None]  # density of an outlier [1/m]

    def update(state, _):
        sigma, outliers, _ = state
        gauss = jnp.exp(-0.5 * (e / sigma) ** 2) / (jnp.sqrt(2 * jnp.pi) * sigma)
        good, bad = (1 - outliers) * gauss, outliers * anything
        share = jnp.where(known, good / (good + bad), 0.0)
        count = jnp.maximum(jnp.sum(share) - freedom, 1.0)
        after = jnp.sqrt(jnp.sum(share * e**2, where=known) / count)
        after = jnp.maximum(after, _SMALLEST)
        gone = 1 - jnp.sum(share) / jnp.maximum(jnp.sum(known), 1)
        gone = jnp.clip(gone, 1e-6, 0.9)
        return (after, gone, jnp.abs(after - sigma) / count**-0.5 / after), count

    start = jnp.maximum(scale_of(e.ravel(), known.ravel()), _SMALLEST)
    state = (start, jnp.full_like(start, 0.1), start)
    (sigma, outliers, change), count = jax.lax.scan(update, state, length=_ROUNDS)
    std = sigma / jnp.sqrt(2 * count[-1])
    return Noise(sigma, std, outliers, poses, change < 0.1)
