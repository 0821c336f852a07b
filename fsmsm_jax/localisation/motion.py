r"""How a robot moves between two scans, and what its odometry is worth.

Wheels are counted, and the count is wrong: a wheel slips, a radius is off. The classic
picture of a motion is to turn towards the goal, drive, and turn into the new heading,
(δ₁, d, δ₂), each with an error that grows with what was done:

    σ(δᵢ) = turn_per_turn |δᵢ| + turn_per_metre d,
    σ(d)  = metre_per_metre d + metre_per_turn (|δ₁| + |δ₂|),

added as squares, over a floor and over a drift that grows with √d: counting wheels is a
random walk, and as far off after ten steps of 0.1 m as after one of 1 m. Particles draw
from it (`sample`), the tracker takes its covariance (`spread`): one model, two uses.

A motion is the new pose in the frame of the old one, `geometry.between(old, new)`. It
is the motion of whatever the poses are of; trackers and filters want that of the lidar,
which `lidar_poses` makes of the robot's.

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, §5.4; driving
backwards and turning on the spot as in ROS's amcl.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry

__all__ = ["OdometryModel", "lidar_poses", "sample", "spread"]

_TINY = 1e-9  # [m] and [rad]
_ON_THE_SPOT = 0.01  # [m]: the direction of a shorter way is rounding and slip


class OdometryModel(eqx.Module):
    """Standard deviations of odometry, per metre and radian of the way."""

    turn_per_turn: ScalarLike = 0.1
    """Error of a turn, per radian turned [rad/rad]."""
    turn_per_metre: ScalarLike = 0.05
    """Error of a turn, per metre driven [rad/m]."""
    metre_per_metre: ScalarLike = 0.1
    """Error of the distance, per metre driven [m/m]."""
    metre_per_turn: ScalarLike = 0.02
    """Error of the distance, per radian turned [m/rad]."""
    floor: tuple[ScalarLike, ScalarLike] = (0.005, 0.005)
    """Error of any motion, even of none [m, rad]."""
    drift: tuple[ScalarLike, ScalarLike] = (0.02, 0.01)
    """Error that grows as a random walk, after one metre [m/√m, rad/√m]."""

    @classmethod
    def amcl(cls, alpha: float = 0.2) -> "OdometryModel":
        """ROS's amcl with its α₁ to α₄ alike, which are squares of ours; no more."""
        if not alpha >= 0:
            raise ValueError(f"amcl's α are not negative, got {alpha}")
        each = math.sqrt(alpha)
        return cls(each, each, each, each, (0.0, 0.0), (0.0, 0.0))


def _norm(a, b):
    """√(a² + b²) that has a derivative at nought."""
    return jnp.sqrt(a**2 + b**2 + _TINY**2)


def _legs(motion):
    """The motion as turn, way, turn; and how far each turn counts as an error [rad]."""
    d = _norm(motion[0], motion[1])
    still = d < _ON_THE_SPOT
    # Derivatives of atan2 at (0, 0) are NaN, so it is asked elsewhere then.
    first = jnp.where(
        still, 0.0, jnp.arctan2(motion[1], jnp.where(still, 1.0, motion[0]))
    )
    second = geometry.wrap(motion[2] - first)
    backwards = lambda turn: jnp.minimum(jnp.abs(turn), jnp.pi - jnp.abs(turn))
    return first, d, second, backwards(first), backwards(second)


def _sigmas(model, motion):
    """Standard deviations of (δ₁, d, δ₂)."""
    _, d, _, turned, turned_back = _legs(motion)
    turn = lambda by: _norm(model.turn_per_turn * by, model.turn_per_metre * d)
    way = _norm(
        model.metre_per_metre * d,
        model.metre_per_turn * _norm(turned, turned_back),
    )
    return turn(turned), way, turn(turned_back)


def _base(model, d):
    """Standard deviations of (x, y, θ) that come on top: floor and drift."""
    each = [
        jnp.sqrt(floor**2 + drift**2 * d + _TINY**2)
        for floor, drift in zip(model.floor, model.drift, strict=True)
    ]
    return jnp.stack([each[0], each[0], each[1]])


def sample(
    key: PRNGKeyArray, model: OdometryModel, motion: Float[Array, "3"]
) -> Float[Array, "3"]:
    """A motion that may have happened when odometry says `motion` [m, m, rad].

    For many particles, `vmap` over keys.
    """
    first, d, second, *_ = _legs(motion)
    key, key_base = jax.random.split(key)
    noise = jax.random.normal(key, (3,), motion.dtype) * jnp.stack(
        _sigmas(model, motion)
    )
    base = _base(model, d)
    d, first, second = d + noise[1], first + noise[0], second + noise[2]
    moved = jnp.stack([d * jnp.cos(first), d * jnp.sin(first), first + second])
    moved = moved + base * jax.random.normal(key_base, (3,), motion.dtype)
    return moved.at[2].set(geometry.wrap(moved[2]))


def spread(model: OdometryModel, motion: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Covariance [m, m, rad]² of the motion, in the frame of the old pose.

    Linearised about `motion`; the second moment of `sample` to first order.
    """
    first, d, _, *_ = _legs(motion)
    c, s = jnp.cos(first), jnp.sin(first)
    zero, one = jnp.zeros_like(d), jnp.ones_like(d)
    J = jnp.stack(
        [
            jnp.stack([-d * s, c, zero]),
            jnp.stack([d * c, s, zero]),
            jnp.stack([one, zero, one]),
        ]
    )
    J = J * jnp.stack(_sigmas(model, motion))[None]
    return J @ J.T + jnp.diag(_base(model, d) ** 2)


def lidar_poses(
    poses_base: Float[Array, "poses 3"], pose_base_lidar: Float[Array, "3"]
) -> Float[Array, "poses 3"]:
    """Poses of the lidar from poses of the robot's base, in the same frame.

    Args:
        poses_base: of the base [m, m, rad], as odometry reports them.
        pose_base_lidar: how the lidar sits in the robot (`/tf_static`, or
            `calibration.mounting`).
    """
    return jax.vmap(geometry.compose, (0, None))(poses_base, pose_base_lidar)
