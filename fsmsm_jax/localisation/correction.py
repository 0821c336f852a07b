r"""From where the robot should be to where it is, though odometry may have slipped.

A descent from the predicted pose alone follows the nearest wall, and one slipped wheel
at a narrow door ends in the next room. So the tracker starts at many places at once:

1. **start** on a lattice of 27 poses around the prediction, as wide as it is uncertain,
   and where the robot would be had it stood still, gone on, or gone backwards;
2. **descend** from each onto the walls, by end points (`descend_end_points`): no cast;
3. **choose** by the likelihood of the end points and of the motion, whose prior weighs
   less and less in its tails: odometry slips, scans do not;
4. **finish** by ranges (`fit_ranges`), to the Cramér–Rao bound; unless the map is known
   to be wrong by decimetres, where end points are the better witness.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fit import descend_end_points, fit_ranges
from fsmsm_jax.alignment.residuals import range_residuals, scale_of
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["CorrectionConfig", "correct", "deviation"]

# Around the prediction, the prediction itself first.
_LATTICE = np.array(sorted(itertools.product((-1, 0, 1), repeat=3), key=np.linalg.norm))


class CorrectionConfig(eqx.Module):
    """How widely and how sharply the pose is searched."""

    rays: int = eqx.field(default=90, static=True)
    """Rays of the search; the finish uses all."""
    finish: int = eqx.field(default=3, static=True)
    """Gauss-Newton steps of the finish."""
    scales: tuple[float, ...] = eqx.field(default=(0.5, 0.4, 0.3, 0.2), static=True)
    """Kernel scales of the descent [m], shrinking."""
    apart: ScalarLike = 2.0
    """Starts lie this many standard deviations beside the prediction."""
    least: tuple[ScalarLike, ScalarLike] = (0.15, 0.04)
    """Standard deviation that the prediction has at least, for the starts [m, rad]."""
    blur: ScalarLike = 0.15
    """Standard deviation of an end point about its wall, when starts compete [m]; more
    where scans usually deviate more: a map that is wrong by decimetres tells less."""
    voices: ScalarLike = 30.0
    """Independent rays that a scan's likelihood counts for."""
    slip: ScalarLike = 4.0
    """Beyond so many standard deviations odometry may as well have slipped."""
    reach: ScalarLike = 0.2
    """How far the finish may lie from the chosen descent [m]."""
    wrong: ScalarLike = 0.2
    """Maps from whose ranges the scans deviate by more [m] get no such finish."""


def correct(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    predicted: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    others: Float[Array, "others 3"],
    usual: ScalarLike,
    config: CorrectionConfig = CorrectionConfig(),
) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, ""]]:
    """The pose that a scan says, near one that is expected.

    Args:
        world: the map.
        scan: the real scan, of any field of view.
        predicted: pose of the lidar in the map frame [m, m, rad].
        covariance: of the prediction [m, m, rad]².
        others: further places to start from; none of them counts as expected.
        usual: by how much scans deviate from this map (`deviation`) [m]; NaN if that
            is not known yet: then this scan's own deviation decides of the finish.
        config: settings.

    Returns:
        The pose, the thickness of the walls as drawn [m] (`fit_ranges`), and the
        `deviation` after the search, before the finish [m].
    """
    few = scan.thin(config.rays)
    sigma = jnp.sqrt(jnp.diagonal(covariance))
    away, turn = config.least
    least = jnp.array([away, away, turn], sigma.dtype)
    beside = config.apart * jnp.maximum(sigma, least)
    lattice = predicted[None] + beside[None] * jnp.asarray(_LATTICE, sigma.dtype)
    starts = jnp.concatenate([lattice, others])

    scales = jnp.asarray(config.scales, sigma.dtype)
    descend = lambda pose: descend_end_points(world, few, pose, scales)
    poses = jax.vmap(descend)(starts)
    blur = jnp.fmax(config.blur, usual)
    witness = jax.vmap(lambda pose: _likelihood(world, few, pose, blur))(poses)
    certainty = jnp.linalg.inv(covariance)
    prior = jax.vmap(lambda pose: _motion_cost(pose, predicted, certainty, config.slip))
    chosen = poses[jnp.argmax(config.voices * witness - prior(poses))]

    off = deviation(world, few, chosen)
    fitted, thickness = fit_ranges(world, scan, chosen, config.finish, config.reach)
    fits = jnp.where(jnp.isnan(usual), off, usual) < jnp.asarray(config.wrong)
    return jnp.where(fits, fitted, chosen), jnp.where(fits, thickness, 0.0), off


def deviation(
    world: OccupancyGrid | PolygonMap, scan: Scan, pose: Float[Array, "3"]
) -> Float[Array, ""]:
    """By how much the ranges deviate from the map's: the σ of their median [m]."""
    e, _, known = range_residuals(world, scan, pose)
    return scale_of(e, known)


def _likelihood(world, scan, pose, blur):
    """Mean log-likelihood of an end point, a tenth of them being anywhere."""
    d = world.distance_at(geometry.transform_points(pose, scan.points))
    log_p = jnp.log(jnp.exp(-0.5 * (d / blur) ** 2) + 0.1)
    return jnp.sum(log_p, where=scan.echo) / jnp.maximum(jnp.sum(scan.echo), 1)


def _motion_cost(pose, predicted, certainty, slip):
    """Half the squared Mahalanobis distance, levelling off at half of slip squared."""
    away = pose - predicted
    away = away.at[2].set(geometry.wrap(away[2]))
    most = 0.5 * slip**2
    return most * (1 - jnp.exp(-0.5 * (away @ certainty @ away) / most))
