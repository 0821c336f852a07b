r"""A car among landmarks, for drives whose truth is known.

The vehicle follows the nominal controls; the drive holds controls and detections with
noise, controls with fresh noise each. It looks before it moves: what it then sees ties
the map to the known start, where otherwise the error of the first move would turn and
shift the whole map for good.

The default is the world in which the specification's numbers were found: 25 landmarks
in a square of 60 m, two laps of a circle of 20 m at 3 m/s, eight controls to a look
(the rates of T. Bailey's simulator), noises of the L-SLAM paper.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax import geometry
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Car, Vehicle, increment

__all__ = ["Circle", "Simulated", "scatter", "simulate"]


class Circle(eqx.Module):
    """Laps of a circle."""

    radius: float = eqx.field(default=20.0, static=True)
    """[m]."""
    centre: tuple[float, float] = eqx.field(default=(20.0, 20.0), static=True)
    """[m]."""
    speed: float = eqx.field(default=3.0, static=True)
    """[m/s]."""
    laps: float = eqx.field(default=2.0, static=True)
    """How many."""
    controls: int = eqx.field(default=8, static=True)
    """Controls to a look."""
    seconds: float = eqx.field(default=0.2, static=True)
    """Between looks [s]."""

    def way(self, vehicle: Car) -> tuple[Array, Array]:
        """Start [m, m, rad] and nominal controls of all steps; the first stands."""
        way = self.laps * 2 * math.pi * self.radius
        steps = math.ceil(way / (self.speed * self.seconds))
        steering = jnp.arctan2(vehicle.wheel_base, self.radius)
        control = [self.speed, steering, self.seconds / self.controls]
        control = jnp.stack([jnp.asarray(number, float) for number in control])
        controls = jnp.broadcast_to(control, (steps + 1, self.controls, 3))
        controls = controls.at[0, :, 2].set(0.0)
        start = [self.centre[0] + self.radius, self.centre[1], math.pi / 2]
        return jnp.stack([jnp.asarray(number, float) for number in start]), controls


class Simulated(NamedTuple):
    """A drive and what happened in truth."""

    drive: Drive
    poses: Float[Array, "steps 3"]
    """At each look [m, m, rad]."""


def scatter(
    key: PRNGKeyArray, number: int = 25, low: float = -10.0, high: float = 50.0
) -> Float[Array, "landmarks 2"]:
    """Landmarks anywhere in a square [m]."""
    return jax.random.uniform(key, (number, 2), minval=low, maxval=high)


def simulate(
    key: PRNGKeyArray,
    landmarks: Float[Array, "landmarks 2"],
    start: Float[Array, "3"],
    controls: Float[Array, "steps controls 3"],
    vehicle: Vehicle,
    sensor: RangeBearing,
    most: int | None = None,
) -> Simulated:
    """Drive nominal controls past landmarks and note what vehicle and sensor say.

    Args:
        key: of all noise.
        landmarks: where they are [m].
        start: where the drive begins [m, m, rad].
        controls: what the vehicle truly does: speed, steering (or turn rate), seconds.
        vehicle: how it moves, and the noise of what it says of that.
        sensor: reach, view and noise.
        most: detections of a look, the nearest; all landmarks by default.
    """
    moves = jax.vmap(lambda u: increment(vehicle, u).pose)(controls)

    def onward(pose, move):
        pose = geometry.compose(pose, move)
        return pose, pose

    _, poses = jax.lax.scan(onward, start, moves)
    keys = jax.random.split(key, 2)
    noise = jnp.stack([*map(jnp.asarray, vehicle.noise)])
    wrong = noise[None, None] * jax.random.normal(keys[0], controls[..., :2].shape)
    said = controls.at[..., :2].add(wrong)

    offset = landmarks[None] - poses[:, None, :2]
    reach = jnp.linalg.norm(offset, axis=-1)
    bearing = jnp.arctan2(offset[..., 1], offset[..., 0]) - poses[:, 2, None]
    bearing = geometry.wrap(bearing)
    inside = (reach < sensor.reach) & (jnp.abs(bearing) < sensor.half_view)
    exact = jnp.stack([reach, bearing], axis=-1)
    sigma = jnp.stack([*map(jnp.asarray, sensor.noise)])
    seen = exact + sigma[None, None] * jax.random.normal(keys[1], exact.shape)
    seen = seen.at[..., 0].max(1e-3)

    most = len(landmarks) if most is None else most
    order = jnp.argsort(jnp.where(inside, reach, jnp.inf), axis=1)[:, :most]
    valid = jnp.take_along_axis(inside, order, axis=1)
    seen = jnp.take_along_axis(seen, order[..., None], axis=1)
    ids = jnp.where(valid, order, -1)
    return Simulated(Drive(said, seen, valid, ids), poses)
