r"""One particle's map: places with a covariance each, in a fixed number of slots.

Given where the vehicle was, landmarks are independent: that is what makes the FastSLAM
family fast. Each is a Kalman filter of two numbers, corrected by its own detections
only.

What if the vehicle's position is itself a distribution (L-SLAM), p ~ N(p⁺, P⁺) after
the look? Given p, landmark m follows m⁺ = m + G (y + p − p⁻), G = Pₘ C⁻¹, C = Pₘ + R;
averaged over p, its covariance is (1 − G) Pₘ + G P⁺ Gᵀ. Position and landmark are
correlated then, and this form forgets by how much: the position is *shared* by all
landmarks, as in the product of the paper's equation (4). `joint` keeps all
correlations, at the cost of large matrices.

A slot is free when its `evidence` is 0. A landmark that is found earns evidence; one
that should have been found and was not loses some, and is dropped when it has none
left.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.slam.belief import PoseBelief, seen_from
from fsmsm_jax.slam.planes import Pair, Sym2
from fsmsm_jax.slam.sensor import RangeBearing, displacement, sight

__all__ = ["Landmarks", "correct", "empty", "in_view"]


class Landmarks(NamedTuple):
    """Slots for landmarks."""

    place: Pair
    """Coordinates [m]."""
    covariance: Sym2
    """Of each place, [m²]."""
    evidence: Float[Array, "*slots"]
    """How sure it is that there is one; 0 for a free slot."""

    @property
    def known(self) -> Bool[Array, "*slots"]:
        """Which slots hold a landmark."""
        return self.evidence > 0


def empty(slots: int) -> Landmarks:
    """A map of nothing."""
    none, one = jnp.zeros(slots), jnp.ones(slots)
    return Landmarks((none, none), Sym2(one, none, one), none)


def correct(
    landmarks: Landmarks,
    belief: PoseBelief,
    sensor: RangeBearing,
    detection: Float[Array, "slots 2"],
    found: Bool[Array, "slots"],
    *,
    expected: bool,
    free: int,
) -> Landmarks:
    """Correct the landmarks that were detected, start those that are new.

    Args:
        landmarks: before.
        belief: of the pose after the look, drawn as far as it is to be drawn.
        sensor: its noise.
        detection: range and bearing for each slot [m, rad].
        found: which slots have a detection; free slots among them start a landmark.
        expected: where to linearise, see `sight`.
        free: coordinates that the belief leaves open: 0, or 2 (position).
    """
    look = sight(sensor, belief.mean, landmarks.place, detection, expected=expected)
    prior = landmarks.covariance
    weight = prior.plus(look.noise).inverse()
    shift = prior.times(weight.times(look.residual))
    offset, started = displacement(sensor, belief.mean[2], detection)
    if free:
        shared = seen_from(belief, look, free)
        weight = weight.minus(shared.within(weight))
        started = started.plus(shared)
    tighter = prior.minus(weight.within(prior))

    known = landmarks.known
    choose = lambda fresh, old, now: jnp.where(found, jnp.where(known, now, fresh), old)
    x, y = landmarks.place
    place = (
        choose(belief.mean[0] + offset[0], x, x + shift[0]),
        choose(belief.mean[1] + offset[1], y, y + shift[1]),
    )
    covariance = Sym2(*map(choose, started, prior, tighter))
    return Landmarks(place, covariance, landmarks.evidence)


def in_view(
    landmarks: Landmarks, pose: Float[Array, "3"], sensor: RangeBearing
) -> Bool[Array, "slots"]:
    """Which known landmarks the sensor should find, well within its limits."""
    x, y = landmarks.place[0] - pose[0], landmarks.place[1] - pose[1]
    bearing = jnp.abs(geometry.wrap(jnp.arctan2(y, x) - pose[2]))
    near = x * x + y * y < jnp.square(0.9 * sensor.reach)
    return landmarks.known & near & (bearing < 0.9 * sensor.half_view)
