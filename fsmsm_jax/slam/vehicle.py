r"""How a vehicle moves by its controls, and how far that can be trusted.

Speed and steering give the rates at which the tracked point (the lidar) moves in its
own frame: forward, leftward, turning. A step is several controls; chained, they make
an *increment*, a pose in the frame of the step's start. Seen from there it is the same
for every particle, wherever it stands and looks, so it is worked out once a step.

Each control is wrong by noise of its own. A wrong turn at control k moves what comes
after it sideways, so to first order the end is off by

$$F_k u_k, \qquad F_k = \begin{bmatrix} R(\varphi_k)\, \partial p_k / \partial u +
J\,(p_{k+1} + \dots + p_K + p_k/2)\, \partial\varphi_k/\partial u \\
\partial \varphi_k / \partial u \end{bmatrix}$$

with p_k the displacement during control k and J a quarter turn; the increment's
covariance is $\sum_k F_k \Sigma F_k^\top$. Displacements point along the heading half
way through the control: the paper leaves open whether it means the one before or after.

Source: V. Petridis, N. Zikos, "L-SLAM", equations (1), (7), (8); the laser's offset and
the encoder's are those of J. Nieto, J. Guivant, E. Nebot for the ACFR utility car.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

__all__ = ["Car", "DiffDrive", "Increment", "Vehicle", "increment"]


class Car(eqx.Module):
    """A car: speed and steering in, rates of the tracked point out."""

    wheel_base: ScalarLike = 2.83
    """Between the axles [m]."""
    wheel_offset: ScalarLike = 0.0
    """How far left of the axle's middle the wheel runs whose speed is counted [m]."""
    tracked: tuple[ScalarLike, ScalarLike] = (0.0, 0.0)
    """The point whose pose is estimated, forward and left of the rear axle [m]."""
    noise: tuple[ScalarLike, ScalarLike] = (0.4, 0.05)
    """σ of speed [m/s] and steering [rad], drawn afresh for each control."""
    trim: tuple[ScalarLike, ScalarLike] = (1.0, 0.0)
    """Scale and offset [rad] that make the true steering of the one that is told; half
    a degree of offset turns a car by a right angle in half a kilometre."""
    front_wheel: bool = eqx.field(default=False, static=True)
    """Whether the speed is the steered front wheel's (as in T. Bailey's simulator)."""

    def rates(self, control: Float[Array, "2"]) -> Float[Array, "3"]:
        """Forward and leftward [m/s] and turning [rad/s], of speed and steering."""
        speed, steering = control
        steering = self.trim[0] * steering + self.trim[1]
        if self.front_wheel:
            speed = speed * jnp.cos(steering)
        curve = jnp.tan(steering) / self.wheel_base
        speed = speed / (1 - self.wheel_offset * curve)
        turn = speed * curve
        ahead, left = self.tracked
        return jnp.stack([speed - turn * left, turn * ahead, turn])


class DiffDrive(eqx.Module):
    """A robot that turns on the spot: speed and turn rate in."""

    noise: tuple[ScalarLike, ScalarLike] = (0.1, 0.1)
    """σ of speed [m/s] and turn rate [rad/s], drawn afresh for each control."""

    def rates(self, control: Float[Array, "2"]) -> Float[Array, "3"]:
        """Forward and leftward [m/s] and turning [rad/s], of speed and turn rate."""
        speed, turn = control
        return jnp.stack([speed, jnp.zeros_like(speed), turn])


Vehicle = Car | DiffDrive


class Increment(NamedTuple):
    """How a vehicle moved, in its own frame at the start."""

    pose: Float[Array, "3"]
    """[m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Of the pose, [m, m, rad]². Of one control it has rank 2."""


def increment(vehicle: Vehicle, controls: Float[Array, "controls 3"]) -> Increment:
    """Chain controls to the motion that they make together.

    Args:
        vehicle: how controls move it, and their noise.
        controls: speed [m/s], steering [rad] (or turn rate [rad/s]), duration [s]. One
            that is not finite, or turns more than once around, moves nothing.

    Example:
        >>> left = jnp.array([[2.0, 0.0, 0.5], [2.0, 0.0, 0.5]])
        >>> moved = increment(Car(), left)
        >>> moved.pose.tolist(), round(float(moved.covariance[0, 0]), 4)
        ([2.0, 0.0, 0.0], 0.08)
    """
    usable = jnp.all(jnp.isfinite(controls), axis=1)
    controls = jnp.where(usable[:, None], controls, 0.0)
    control, seconds = controls[:, :2], controls[:, 2]
    rates = jax.vmap(vehicle.rates)(control) * seconds[:, None]
    slopes = jax.vmap(jax.jacfwd(vehicle.rates))(control) * seconds[:, None, None]

    sane = jnp.abs(rates[:, 2]) < 2 * jnp.pi
    rates = jnp.where(sane[:, None], rates, 0.0)
    slopes = jnp.where(sane[:, None, None], slopes, 0.0)

    turned = jnp.cumsum(rates[:, 2])
    along = turned - rates[:, 2] / 2
    c, s = jnp.cos(along), jnp.sin(along)
    turn = jnp.stack([jnp.stack([c, -s], -1), jnp.stack([s, c], -1)], axis=1)
    steps = jnp.sum(turn * rates[:, None, :2], axis=-1)
    end = jnp.sum(steps, axis=0)
    ahead = end[None] - jnp.cumsum(steps, axis=0) + steps / 2

    lever = jnp.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    slid = jnp.einsum("kij,kju->kiu", turn, slopes[:, :2])
    slid = slid + lever[:, :, None] * slopes[:, 2, None, :]
    effect = jnp.concatenate([slid, slopes[:, 2:]], axis=1)
    effect = effect * jnp.stack([*map(jnp.asarray, vehicle.noise)])[None, None]
    covariance = jnp.einsum("kiu,kju->ij", effect, effect)
    return Increment(jnp.append(end, jnp.sum(rates[:, 2])), covariance)
