r"""A landmark seen at a range and a bearing, made linear in two ways.

Where is the landmark from the vehicle, along the axes of the map? Detection (d, θ) at
heading φ says

$$z' = d\,[\cos a, \sin a], \quad a = \varphi + \theta, \qquad m - p$$

is what map and position say. The noise of z' lies along the ray (σ_d) and across it
(d σ_θ). With the heading given, z' is *linear* in position p and landmark m, with
constant coefficients: that is L-SLAM's idea (equations 9 to 12), and a Kalman filter
needs nothing else. Its noise is drawn at where the detection points.

FastSLAM linearises range and bearing at where the landmark is *expected*. In the frame
turned into that direction this reads just the same: residual Δd along and d̂ Δθ across,
noise drawn at the expected place, coefficients 1. So one `Sight` serves both, and the
filters differ only in `expected`. A likelihood of z' differs from one of (d, θ) by
the factor d̂, which `log_scale` holds.

To first order the residual moves with the vehicle's pose by [1, 0, −d sin a] and
[0, 1, d cos a]: `arm` is its derivative by the heading.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax.slam.planes import Pair, Sym2

__all__ = ["RangeBearing", "Sight", "displacement", "sight"]


class RangeBearing(eqx.Module):
    """A sensor that finds landmarks."""

    noise: tuple[ScalarLike, ScalarLike] = (0.1, 0.01)
    """σ of range [m] and bearing [rad]."""
    reach: ScalarLike = 30.0
    """How far it finds landmarks [m]."""
    half_view: ScalarLike = math.pi / 2
    """To which bearing on either side it finds them [rad]."""


class Sight(NamedTuple):
    """How far landmarks are from where they were detected, linear in the pose."""

    residual: Pair
    """Detected less expected displacement, along the map's axes [m]."""
    noise: Sym2
    """Of the detection [m²]."""
    arm: Pair
    """Derivative of the residual by the heading [m/rad]."""
    log_scale: Float[Array, "*shape"]
    """What the logarithm of a likelihood in ranges and bearings has on top."""


def displacement(
    sensor: RangeBearing,
    heading: Float[Array, ""],
    detection: Float[Array, "*shape 2"],
) -> tuple[Pair, Sym2]:
    """Where a detection lies from the vehicle along the map's axes, and its noise.

    Args:
        sensor: its noise.
        heading: of the vehicle [rad].
        detection: range [m] and bearing [rad].
    """
    reach = detection[..., 0]
    direction = _direction(heading, detection[..., 1])
    sigma, spread = sensor.noise
    noise = Sym2.along(direction, jnp.square(sigma), jnp.square(spread * reach))
    return (reach * direction[0], reach * direction[1]), noise


def sight(
    sensor: RangeBearing,
    pose: Float[Array, "3"],
    landmark: Pair,
    detection: Float[Array, "*#shape 2"],
    *,
    expected: bool,
) -> Sight:
    """Compare detections with landmarks.

    Args:
        sensor: its noise.
        pose: of the vehicle [m, m, rad].
        landmark: places [m], of the detections' shape or one that broadcasts.
        detection: range [m] and bearing [rad], above zero range.
        expected: whether to linearise where the landmark is expected (FastSLAM, EKF)
            rather than where it was detected (L-SLAM).
    """
    x, y = landmark[0] - pose[0], landmark[1] - pose[1]
    if not expected:
        (along, across), noise = displacement(sensor, pose[2], detection)
        none = jnp.zeros_like(x + along)
        noise = Sym2(*(none + entry for entry in noise))  # of the residuals' shape
        return Sight(
            (along - x, across - y), noise, (none - across, none + along), none
        )
    sigma, spread = sensor.noise
    here = x * x + y * y < 1e-6  # within a millimetre there is no direction: ahead
    x, y = jnp.where(here, 1e-3, x), jnp.where(here, 0.0, y)
    reach = jnp.sqrt(x * x + y * y)
    c, s = x / reach, y / reach
    u, v = _direction(pose[2], detection[..., 1])
    ahead = detection[..., 0] - reach
    aside = reach * jnp.arctan2(c * v - s * u, c * u + s * v)
    noise = Sym2.along((c, s), jnp.square(sigma), jnp.square(spread * reach))
    residual = c * ahead - s * aside, s * ahead + c * aside
    return Sight(residual, noise, (-y + 0 * ahead, x + 0 * ahead), jnp.log(reach))


def _direction(heading, bearing):
    """Unit vector; by addition, as bearings are the same for all particles."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    u, v = jnp.cos(bearing), jnp.sin(bearing)
    return c * u - s * v, s * u + c * v
