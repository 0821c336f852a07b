r"""Landmark SLAM as a pure step: state in, state and info out.

One step is the same for the whole family (`methods`): every particle is *moved* by the
controls, draws what it draws, pairs the detections with its landmarks, is *informed* by
them (or draws only now), corrects its map, and is *weighed* by how likely the
detections were. If the effective number of particles 1 / Σ w² falls under three
quarters of them, they are drawn again by weight with one comb (residual systematic
resampling).

`run` is `step` under `jax.lax.scan`; keys of many seeds go through `jax.vmap`.

Source: V. Petridis, N. Zikos, "L-SLAM", §3, equations (4) to (16); M. Montemerlo et
al., "FastSLAM" 2002, "FastSLAM 2.0" 2003.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.resampling import systematic
from fsmsm_jax.slam import factored, joint
from fsmsm_jax.slam.association import Association, luck_of
from fsmsm_jax.slam.belief import PoseBelief
from fsmsm_jax.slam.drive import Drive, Numbers, seen
from fsmsm_jax.slam.factored import Particle
from fsmsm_jax.slam.joint import Joint
from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.methods import METHODS, Name
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Car, Vehicle, increment

__all__ = ["Info", "SlamConfig", "State", "init", "run", "step"]


class SlamConfig(eqx.Module):
    """A filter and what it is told of the vehicle and the sensor."""

    method: Name = eqx.field(default="lslam2", static=True)
    """See `methods`."""
    particles: int = eqx.field(default=40, static=True)
    """How many; `ekf` has one."""
    landmarks: int = eqx.field(default=64, static=True)
    """Slots of a particle's map."""
    vehicle: Vehicle = Car()
    """How controls move it."""
    sensor: RangeBearing = RangeBearing()
    """How it finds landmarks."""
    association: Association | None = Association()
    """How detections find landmarks; None to believe the ids of the drive."""
    resample_below: ScalarLike = 0.75
    """Share of effective particles under which they are drawn again."""

    def __check_init__(self):
        if self.method not in METHODS:
            raise ValueError(
                f"there is no method {self.method!r}: one of {', '.join(METHODS)}"
            )
        if self.particles < 1 or self.landmarks < 1:
            raise ValueError(
                "expected at least one particle and one landmark, got "
                f"{self.particles} and {self.landmarks}"
            )
        if self.method == "ekf" and self.particles != 1:
            object.__setattr__(self, "particles", 1)


class State(NamedTuple):
    """All particles."""

    particles: Particle | Joint
    """With a leading axis."""
    log_weight: Float[Array, "particles"]
    """Normalised."""
    best: Int[Array, ""]
    """Which particle weighed most in the last step, before they were drawn again."""
    key: PRNGKeyArray
    """Of the draws to come."""

    @property
    def landmarks(self) -> Landmarks:
        """The map of that particle; for one state, not for a batch of them."""
        return jax.tree.map(lambda a: a[self.best], self.particles.landmarks)


class Info(NamedTuple):
    """A step's estimate, with what a person would plot."""

    pose: Float[Array, "*steps 3"]
    """Of the particle that weighs most [m, m, rad], as the paper reports it."""
    covariance: Float[Array, "*steps 3 3"]
    """Of all particles about their mean, and in each of them."""
    mean: Float[Array, "*steps 3"]
    """Of all particles: steadier where many are in the race, as the heaviest changes
    and each has its own map."""
    effective: Float[Array, "*steps"]
    """Effective number of particles."""
    known: Int[Array, "*steps"]
    """Landmarks on the map of the heaviest particle."""
    matched: Int[Array, "*steps"]
    """Its detections that were of known landmarks."""
    unplaced: Int[Array, "*steps"]
    """Its detections of new landmarks for which there was no slot."""
    log_evidence: Float[Array, "*steps"]
    """Log-likelihood of the detections, given all before; its sum over a drive is the
    evidence for what the filter was told of vehicle and sensor."""
    usable: Bool[Array, "*steps"]
    """Whether any particle explains the detections; else weights stay as they were."""


def init(
    config: SlamConfig,
    key: PRNGKeyArray,
    start: Float[Numbers, "3"] | None = None,
    covariance: Float[Numbers, "3 3"] | None = None,
) -> State:
    """A vehicle at a pose, with an empty map.

    Args:
        config: the filter.
        key: of all its draws.
        start: pose [m, m, rad]; the origin by default, as nothing tells where it is.
        covariance: of the start, zero by default: it is where it is.
    """
    mean = jnp.zeros(3) if start is None else jnp.asarray(start, float)
    spread = jnp.zeros((3, 3)) if covariance is None else jnp.asarray(covariance, float)
    belief = PoseBelief(mean, spread)
    keeper = joint if METHODS[config.method].joint else factored
    particle = keeper.blank(belief, config.landmarks)
    repeat = lambda a: jnp.broadcast_to(a, (config.particles, *a.shape))
    return State(
        jax.tree.map(repeat, particle), _level(config), jnp.zeros((), int), key
    )


def _level(config):
    """Logarithms of equal weights."""
    return jnp.full(config.particles, -math.log(config.particles), float)


@jax.jit
def step(config: SlamConfig, state: State, frame: Drive) -> tuple[State, Info]:
    """Move, look, weigh, and draw again if need be.

    Args:
        config: the filter.
        state: from `init` or the step before.
        frame: one step of a drive, without leading axes.

    Returns:
        The state after and the estimate. It stays finite whatever comes: controls that
        are not finite move nothing, detections that are not valid are left alone, and
        a particle that can make no sense of the look stays as it was before the step.
    """
    method = METHODS[config.method]
    key, *keys = jax.random.split(state.key, 4)
    frame = seen(frame)
    moved = increment(config.vehicle, jnp.asarray(frame.controls))
    normals = jax.random.normal(keys[0], (config.particles, 3))
    size = len(frame.valid), config.landmarks, config.particles
    luck = luck_of(keys[1], config.association, *size)
    keeper = joint if method.joint else factored

    def advance(particle, normals, start):
        told = method, config.sensor, config.association, moved, frame
        mine = luck._replace(start=start)
        return keeper.advance(*told, particle, normals, mine)

    after, pairing = jax.vmap(advance)(state.particles, normals, luck.start)
    sound = _finite(after) & jnp.isfinite(pairing.log_likelihood)
    # A particle that can make no sense of the look stays as it was, without weight.
    keep = lambda a, b: jnp.where(sound.reshape(-1, *[1] * (a.ndim - 1)), a, b)
    particles = jax.tree.map(keep, after, state.particles)

    log_weight = state.log_weight + pairing.log_likelihood
    finite = jnp.where(sound, log_weight, -jnp.inf)
    usable = jnp.any(jnp.isfinite(finite))
    finite = jnp.where(usable, finite, state.log_weight)
    evidence = jax.nn.logsumexp(finite)
    log_weight = finite - evidence
    weight = jnp.exp(log_weight)
    effective = 1 / jnp.sum(weight * weight)
    known = state.particles.landmarks.known
    info = _info(particles, pairing, known, weight, effective, evidence, usable)

    again = effective < config.resample_below * config.particles
    chosen = systematic(keys[2], weight, config.particles)
    chosen = jnp.where(again, chosen, jnp.arange(config.particles))
    particles = jax.tree.map(lambda a: a[chosen], particles)
    # The heaviest is drawn at least once.
    best = jnp.argmax(chosen == jnp.argmax(log_weight))
    log_weight = jnp.where(again, _level(config), log_weight)
    return State(particles, log_weight, best, key), info


@jax.jit
def run(config: SlamConfig, state: State, drive: Drive) -> tuple[State, Info]:
    """`step` through a whole drive.

    Args:
        config: the filter.
        state: from `init`.
        drive: from `tidied`, a log reader or the simulator.

    Returns:
        The state after the last step and the estimates of all.
    """
    return jax.lax.scan(lambda state, frame: step(config, state, frame), state, drive)


def _finite(particles):
    """Which particles are made of finite numbers."""
    good = lambda a: jnp.all(jnp.isfinite(a), axis=tuple(range(1, a.ndim)))
    return jnp.all(jnp.stack([good(a) for a in jax.tree.leaves(particles)]), axis=0)


def _info(particles, pairing, before, weight, effective, evidence, usable):
    """The estimate of weighted particles."""
    means, covariances = particles.belief
    best = jnp.argmax(weight)
    pose = means[best]
    off = means - pose[None]
    off = off.at[:, 2].set(geometry.wrap(off[:, 2]))
    mean = jnp.sum(weight[:, None] * off, axis=0)
    off = off - mean[None]
    spread = covariances + off[:, :, None] * off[:, None, :]
    wrapped = lambda pose: pose.at[2].set(geometry.wrap(pose[2]))
    return Info(
        wrapped(pose),
        jnp.sum(weight[:, None, None] * spread, axis=0),
        wrapped(pose + mean),
        effective,
        jnp.sum(particles.landmarks.known[best]),
        jnp.sum((pairing.detection[best] >= 0) & before[best]),
        pairing.unplaced[best],
        evidence,
        usable,
    )
