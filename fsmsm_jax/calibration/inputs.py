"""What every calibration asks of its input, and what it makes of it.

Scans come stacked along a leading axis, one pose each. A few rays of many scans teach
more than all rays of few, so scans are thinned to every k-th ray, in order: a spinning
sensor takes its rays one after the other, and neighbours stay neighbours.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax.alignment.residuals import range_residuals
from fsmsm_jax.calibration.separable import Linearised
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["across_walls", "check", "determined", "finite", "thinned"]

_FEWEST_ECHOES = 10  # three numbers a pose, and some rays hit what is not drawn
_TOLD = 0.1  # what rays leave of a spread, for its unknown to count as told by them


def check(
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    fewest: int,
    name: str = "poses",
) -> Float[Array, "scans 3"]:
    """The poses as an array, if there is one for each of enough usable scans.

    Raises:
        ValueError: the scans are not stacked, are fewer than `fewest`, or one has fewer
            than 10 echoes; the poses are not (scans, 3) finite numbers.
    """
    if np.ndim(scans.ranges) != 2:
        raise ValueError(
            f"expected scans stacked along a leading axis, (scans, rays) ranges; got "
            f"shape {np.shape(scans.ranges)}"
        )
    count = len(scans.ranges)
    if count < fewest:
        raise ValueError(f"a calibration needs at least {fewest} scans, got {count}")
    poses = finite(poses, (count, 3), name)
    echoes = np.sum(np.asarray(scans.echo), axis=-1)
    if np.min(echoes) < _FEWEST_ECHOES:
        raise ValueError(
            f"scan {int(np.argmin(echoes))} has {np.min(echoes)} echoes, it takes at "
            f"least {_FEWEST_ECHOES}; check range_max and units, or leave it out"
        )
    return poses


def finite(
    values: Sequence | np.ndarray | Array, shape: tuple[int, ...], name: str
) -> Float[Array, "..."]:
    """The values as an array of that shape.

    Raises:
        ValueError: they have another shape or are not all finite.
    """
    values = np.asarray(values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be finite numbers of shape {shape}, got shape {values.shape}"
            f" with {np.sum(~np.isfinite(values))} not finite"
        )
    return jnp.asarray(values, float)


def thinned(scans: Scan, rays: int) -> Scan:
    """Every k-th ray of stacked scans, so that at least `rays` are left."""
    every = max(1, scans.ranges.shape[-1] // rays)
    part = lambda a: a[:, ::every] if a.ndim == 2 else a
    return jax.tree.map(part, scans)


def across_walls(
    world: OccupancyGrid | PolygonMap, scan: Scan, pose: Float[Array, "3"]
) -> tuple[Linearised, Float[Array, "rays"]]:
    """A scan's `range_residuals`, and by what to divide them before they are compared.

    Drawn walls of a grid stand some centimetres off, which a slanted ray sees enlarged
    by 1/|n·d|; the sensor's own noise, all there is in polygons, knows no slant.
    """
    e, J, known = range_residuals(world, scan, pose)
    slant = J[:, 3] if isinstance(world, OccupancyGrid) else jnp.ones_like(e)
    return Linearised(e, J[:, :3], known), slant


def determined(
    covariance: Float[Array, "n n"], spread: Float[Array, "n"]
) -> Bool[Array, "n"]:
    """Which unknowns the rays tell, and which are just what was assumed."""
    return jnp.sqrt(jnp.diag(covariance)) < _TOLD * spread
