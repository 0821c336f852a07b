r"""Monte Carlo localisation: many guesses, moved, weighed and drawn again.

A cloud of particles is a belief that may have any shape: one peak, five equal rooms, or
no idea. Each `step` takes an odometry pose and a scan and

1. **moves** every particle by a motion that odometry may have meant (`motion.sample`);
2. **weighs** it by how likely the scan is from there (`likelihood`);
3. **says** one pose, the mean of selected particles, matched to the scan if asked for
   (`feedback.select`, `correct`);
4. **draws** particles again now and then, as many as the belief is wide
   (`resampling`), and tells them of the match (`feed_back`).

A cloud is an array with room for all and a count of those that live, so shapes never
change: `lax.scan` runs a log (`run`), and `vmap` over keys repeats it. How it begins:
`clouds`.

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, §8.3; ROS's
amcl, whose settings the thesis uses (§4); it draws no recovery particles.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.localisation.feedback import (
    Feedback,
    ScanMatching,
    Selection,
    correct,
    feed_back,
    select,
    weighted_pose,
)
from fsmsm_jax.localisation.likelihood import (
    CaerLikelihood,
    LikelihoodField,
    log_likelihoods,
)
from fsmsm_jax.localisation.motion import OdometryModel, sample
from fsmsm_jax.resampling import (
    Kld,
    kld_count,
    residual_systematic,
    systematic,
)
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = [
    "ParticleConfig",
    "ParticleInfo",
    "Particles",
    "run",
    "step",
]

_RESAMPLERS = {"systematic": systematic, "residual": residual_systematic}


class Particles(NamedTuple):
    """What the filter believes: the first `living` particles and their weights."""

    poses: Float[Array, "particles 3"]
    """Of the lidar in the map [m, m, rad]."""
    log_weights: Float[Array, "particles"]
    """Normalised: as weights they sum to 1. −inf where no particle lives."""
    living: Int[Array, ""]
    """How many there are."""
    odometry: Float[Array, "3"]
    """Odometry at the last update [m, m, rad]; NaN before the first."""
    updates: Int[Array, ""]
    """Scans that were weighed."""

    @property
    def alive(self) -> Bool[Array, "particles"]:
        """Which rows of the arrays are particles."""
        return jnp.arange(self.log_weights.shape[-1]) < self.living[..., None]


class ParticleConfig(eqx.Module):
    """How the filter works; numbers are the thesis's, or amcl's where it is silent."""

    motion: OdometryModel = OdometryModel()
    """How wrong odometry is."""
    likelihood: LikelihoodField | CaerLikelihood = LikelihoodField()
    """How scans are weighed."""
    kld: Kld = Kld()
    """How many particles there are."""
    resampler: str = eqx.field(default="systematic", static=True)
    """"systematic" (low variance) or "residual" (residual systematic)."""
    resample_interval: int = 5
    """Scans that are weighed between two resamplings; weights gather meanwhile."""
    update_min_d: ScalarLike = 0.01
    """Scans are left alone until the robot has driven this far [m],"""
    update_min_a: ScalarLike = 0.05
    """or turned by this much [rad]."""
    selection: Selection = Selection()
    """Which particles the output is the mean of."""
    matching: ScanMatching | None = None
    """How the output is matched to its scan; None: it is not."""
    feedback: Feedback = Feedback()
    """What the particles are told of the match."""

    def __check_init__(self):
        if self.resampler not in _RESAMPLERS:
            raise ValueError(
                f"resampler must be one of {list(_RESAMPLERS)}, got {self.resampler!r}"
            )
        if self.matching is None and self.feedback.manner != "open":
            raise ValueError(
                f"nothing is there to feed back ({self.feedback.manner!r}); "
                "set matching=ScanMatching()"
            )


class ParticleInfo(NamedTuple):
    """What one step did; all that one would plot."""

    pose: Float[Array, "3"]
    """Output: weighted mean of the selected particles [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Of all particles about their mean [m, m, rad]²."""
    corrected: Float[Array, "3"]
    """The output matched to the scan; the output where that failed or was not asked."""
    matched: Bool[Array, ""]
    """Whether it was matched."""
    best: Float[Array, "3"]
    """The heaviest particle."""
    effective: Float[Array, ""]
    """N_eff = 1 / Σ w²: particles that still have a say, before resampling."""
    living: Int[Array, ""]
    """Particles alive after the step."""
    updated: Bool[Array, ""]
    """Whether the scan was weighed: the robot had moved, and odometry was finite."""
    resampled: Bool[Array, ""]
    """Whether particles were drawn again."""


def step(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    state: Particles,
    scan: Scan,
    odometry: Float[Array, "3"],
    config: ParticleConfig = ParticleConfig(),
) -> tuple[Particles, ParticleInfo]:
    """One scan, and how the robot got to where it was taken.

    Args:
        key: of all that is random.
        world: the map.
        state: what is believed, from an `init_…` or the last step.
        scan: one scan.
        odometry: pose of the lidar in odometry's frame [m, m, rad].
        config: settings.

    Returns:
        What is believed now, and what was done. Where odometry is not finite or the
        robot has not moved, the state is returned as it came, and the output is the
        old one carried along. The first scan is always weighed. A scan without
        information, or one that is impossible from everywhere, leaves the weights as
        they are. Nothing is ever NaN but the state's odometry before the first update.
    """
    known = jnp.all(jnp.isfinite(odometry))
    first = ~jnp.all(jnp.isfinite(state.odometry))
    before = jnp.where(first, odometry, state.odometry)
    motion = jnp.where(known, geometry.between(before, odometry), 0.0)
    far = jnp.linalg.norm(motion[:2]) >= config.update_min_d
    updated = known & (first | far | (jnp.abs(motion[2]) >= config.update_min_a))
    # Not lax.cond: under vmap it would copy the world for every seed.
    new = _update(key, world, state, scan, odometry, motion, first, config)
    old = state, _carried(state, motion, config)
    return jax.tree.map(lambda a, b: jnp.where(updated, a, b), new, old)


def _update(key, world, state, scan, odometry, motion, first, config):
    key_move, key_draw, key_tell = jax.random.split(key, 3)
    moved = _moved(key_move, state.poses, motion, config.motion)
    poses = jnp.where(first, state.poses, moved)
    log_weights = _weighed(
        state, log_likelihoods(world, scan, poses, config.likelihood)
    )
    info = _said(poses, log_weights, state.living, config.selection)
    if config.matching is not None:
        corrected, matched = correct(world, scan, info.pose, config.matching)
        info = info._replace(corrected=corrected, matched=matched)

    updates = state.updates + 1
    resampled = updates % config.resample_interval == 0
    cloud = jax.lax.cond(
        resampled,
        lambda: _drawn(key_draw, poses, log_weights, config),
        lambda: (poses, log_weights, state.living),
    )
    told = feed_back(key_tell, *cloud, info.corrected, config.feedback)
    told = jax.tree.map(lambda new, old: jnp.where(info.matched, new, old), told, cloud)
    poses, log_weights, living = told
    state = Particles(poses, log_weights, living, odometry, updates)
    info = info._replace(living=state.living, updated=True, resampled=resampled)
    return state, jax.tree.map(jnp.asarray, info)


def _moved(key, poses, motion, model):
    """Each particle moved by a motion of its own."""
    keys = jax.random.split(key, len(poses))
    motions = jax.vmap(sample, (0, None, None))(keys, model, motion)
    return jax.vmap(geometry.compose)(poses, motions)


def _weighed(state, log_likelihood):
    """Weights times likelihoods, normalised; as they were if nothing would be left."""
    product = jnp.where(state.alive, state.log_weights + log_likelihood, -jnp.inf)
    total = jax.nn.logsumexp(product)
    return jnp.where(jnp.isfinite(total), product - total, state.log_weights)


def _drawn(key, poses, log_weights, config):
    """A new population, as many as KLD-sampling asks for."""
    key_size, key_order, key_draw = jax.random.split(key, 3)
    draw, room = _RESAMPLERS[config.resampler], len(poses)
    weights = jnp.exp(log_weights)
    trial = jax.random.permutation(key_order, draw(key_size, weights, room))
    count = kld_count(poses[trial], config.kld)
    poses = poses[draw(key_draw, weights, room, count)]
    alive = jnp.arange(room) < count
    even = -jnp.log(count.astype(poses.dtype))
    return poses, jnp.where(alive, even, -jnp.inf), count


def _said(poses, log_weights, living, selection):
    """The output, and the shape of the cloud."""
    weights = jnp.exp(log_weights)
    pose, _ = weighted_pose(poses, select(log_weights, living, selection))
    _, covariance = weighted_pose(poses, weights)
    return ParticleInfo(
        pose=pose,
        covariance=covariance,
        corrected=pose,
        matched=jnp.asarray(False),
        best=poses[jnp.argmax(log_weights)],
        effective=1 / jnp.sum(weights**2),
        living=living,
        updated=jnp.asarray(False),
        resampled=jnp.asarray(False),
    )


def _carried(state, motion, config):
    """What was said last, moved along with the robot."""
    info = _said(state.poses, state.log_weights, state.living, config.selection)
    pose, best = (geometry.compose(p, motion) for p in (info.pose, info.best))
    return info._replace(pose=pose, corrected=pose, best=best)


def run(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    state: Particles,
    scans: Scan,
    odometry: Float[Array, "times 3"],
    config: ParticleConfig = ParticleConfig(),
) -> tuple[Particles, ParticleInfo]:
    """A whole log: `step` by step, under `lax.scan`.

    Args:
        key: of all that is random; `vmap` over keys repeats the log.
        world: the map.
        state: what is believed before the first scan.
        scans: stacked along a leading axis, ranges (times, rays).
        odometry: poses of the lidar in odometry's frame [m, m, rad], one a scan.
        config: settings.

    Returns:
        What is believed after the last scan, and the infos of all steps, stacked.
    """

    def one(state, job):
        key, scan, odometry = job
        return step(key, world, state, scan, odometry, config)

    keys = jax.random.split(key, len(odometry))
    return jax.lax.scan(one, state, (keys, scans, odometry))
