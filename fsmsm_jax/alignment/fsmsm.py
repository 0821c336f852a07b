r"""FSMSM: scan-to-map-scan matching by turns and steps, without correspondences.

Orientation is exact only from the right position and position only with the right
heading, so the two alternate. One **outer step** at sampling degree ν:

1. *Theseus*: one cast of 2^ν N rays gives 2^ν headings that the scan might have.
2. *Rehearsal*: each of them, and one remembered from earlier, takes a step of the
   position law; the CAER it then has says how good the heading was. Percent
   discrimination cannot say it: it judges from the wrong position.
3. The best one takes I_T(ν) steps of the position law in earnest.

When the heading has come to rest, ν rises. An estimate that leaves the map, or ends
with more CAER than the noise explains, starts again near where it was first believed
to be (a *recovery*).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import caer_per_ray
from fsmsm_jax.alignment.first_estimate import one_world, strayed
from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.fsmsm_config import Alignment, FsmsmConfig
from fsmsm_jax.alignment.position import translate
from fsmsm_jax.alignment.rounds import in_rounds
from fsmsm_jax.alignment.theseus import distinct_headings, theseus
from fsmsm_jax.sensing import Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["fsmsm"]

_HISTORY = 64  # headings remembered for the convergence test: more than a match takes
_AT_REST = 1e-5  # [rad] ε_δp: a heading that comes back this near has come to rest
_SURE = 0.99999  # percent discrimination at which lower levels have nothing to add
_SLACK = 0.01  # [m] that a walk may leave the box
_DRAWS = 32  # poses drawn at a recovery to find one inside the map


class _State(NamedTuple):
    """One match under way."""

    pose: Float[Array, "3"]
    caer: Float[Array, ""]  # per ray [m]
    stage: Int[Array, ""]  # index into the levels, then the finish, then done
    counter: Int[Array, ""]  # outer steps at this level
    remembered: Float[Array, "3"]  # a pose, or (0, 0, angle) for "turn"
    least: Float[Array, ""]  # CAER per ray of the remembered rehearsal [m]
    headings: Float[Array, "history"]  # after each outer step; NaN: not yet
    geared_up: Bool[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    scans: Int[Array, ""]
    recoveries: Int[Array, ""]
    key: PRNGKeyArray


class _Job(NamedTuple):
    """What one match is about."""

    ranges: Float[Array, "rays"]
    mask: Bool[Array, "rays"] | None
    start: Float[Array, "3"]
    world: OccupancyGrid | PolygonMap | None  # None: all share one


def fsmsm(
    worlds: OccupancyGrid | PolygonMap,
    ranges: Float[Array, "batch rays"],
    poses: Float[Array, "batch 3"],
    config: FsmsmConfig = FsmsmConfig(),
    *,
    mask: Bool[Array, "batch rays"] | None = None,
    range_max: ScalarLike = 30.0,
    key: PRNGKeyArray | None = None,
    block: int = 32,
) -> Alignment:
    """Match panoramic scans against their maps, each from its own estimate.

    Args:
        worlds: one map for all scans, or a pytree of maps with a leading batch axis.
        ranges: real scans [m], ray n at bearing −π + 2πn/N.
        poses: estimates [x, y, θ] in the map frame [m, m, rad].
        config: settings.
        mask: valid rays of the real scans; if left out all are. Only
            "fourier_mellin" can do with one.
        range_max: cap of the virtual ranges [m], the sensor's own.
        key: for the poses that recoveries draw.
        block: matches that advance together (`in_rounds`); static.

    Returns:
        One result a scan, in order.

    Reference:
        Algorithm XXIII of the thesis with XVII to XXII, and what its program does
        (errata E4, E6 to E8, E14 to E16).

    Note:
        A loop of unknown length: not differentiable in reverse mode, not for `vmap`
        (it is a batch). `match` is the entry for a scan of any field of view.
    """
    key = jax.random.key(0) if key is None else key
    shared = worlds if one_world(worlds) else None
    common = dict(config=config, shared=shared, range_max=range_max)
    stages = [
        partial(_outer_step, index, **common) for index in range(len(config.levels))
    ]
    if config.finish:
        stages.append(partial(_finish, **common))
    keys = jax.random.split(key, len(poses))
    state = jax.vmap(_begin, (None, 0, 0))(config, poses, keys)
    jobs = _Job(ranges, mask, poses, None if shared is not None else worlds)
    state = in_rounds(stages, lambda state: state.stage, state, jobs, block)
    return Alignment(
        state.pose,
        state.caer,
        state.converged,
        state.steps,
        state.scans,
        state.recoveries,
    )


def _begin(config, pose, key):
    zero, no = jnp.zeros((), int), jnp.zeros((), bool)
    infinite = jnp.full((), jnp.inf, pose.dtype)
    return _State(
        pose=pose,
        caer=infinite,
        stage=zero,
        counter=zero,
        remembered=jnp.zeros_like(pose) if config.memory == "turn" else pose,
        least=infinite,
        headings=jnp.full(_HISTORY, jnp.nan, pose.dtype),
        geared_up=no,
        converged=no,
        steps=zero,
        scans=zero,
        recoveries=zero,
        key=key,
    )


def _outer_step(index, state, job, *, config, shared, range_max):
    """Theseus, rehearsal, translation: then stay, climb or recover."""
    world = job.world if shared is None else shared
    nu, top = config.levels[index], len(config.levels) - 1
    walk = partial(
        translate,
        world,
        job.ranges,
        mask=job.mask,
        gate=config.gate,
        range_max=range_max,
        reach=config.box[0] + _SLACK,
        cap=config.cap,
    )
    valid = job.ranges.size if job.mask is None else jnp.maximum(jnp.sum(job.mask), 1)

    poses, similarity = _candidates(config, nu, world, range_max, state, job)
    tried = jax.vmap(lambda pose: walk(pose, iterations=2))(poses)
    costs = jnp.where(tried.stayed, tried.caers[:, -1] / valid, jnp.inf)
    best = jnp.argmin(costs)
    rehearsed = tried.pose[best]
    chosen = rehearsed if config.memory == "pose" else poses[best]
    if config.memory == "turn":
        memory = jnp.zeros_like(chosen).at[2].set(chosen[2] - state.pose[2])
    else:
        memory = chosen
    remembered = jnp.where(costs[best] < state.least, memory, state.remembered)

    moved = walk(chosen, iterations=config.translations[index])
    pose = moved.least if config.keep_least else moved.pose
    pose = pose.at[2].set(geometry.wrap(pose[2]))
    caer = (jnp.min(moved.caers) if config.keep_least else moved.caers[-1]) / valid

    came_back = jnp.abs(geometry.wrap(state.headings - pose[2])) < _AT_REST
    at_rest = jnp.any(came_back) & (state.counter >= config.settle)
    climb = at_rest | (state.counter > config.max_steps)
    sure = climb & ~state.geared_up & (similarity[best] > _SURE)

    lost = jnp.isinf(costs[best]) | ~moved.stayed | strayed(config, pose, job.start)
    if index == top:
        lost |= caer > config.caer_limit

    # The very first heading is no evidence of rest: it may be the estimate's own.
    heading = jnp.where(state.steps > 0, pose[2], jnp.nan)
    state = state._replace(
        pose=pose,
        caer=caer,
        stage=jnp.where(sure, top, index + climb),
        counter=jnp.where(climb, 0, state.counter + 1),
        remembered=remembered,
        least=jnp.minimum(costs[best], state.least),
        headings=state.headings.at[state.steps % _HISTORY].set(heading),
        geared_up=state.geared_up | sure,
        converged=~lost,
        steps=state.steps + 1,
        scans=state.scans + 2**nu + 2 * len(poses) + config.translations[index],
    )
    return _recover_if(lost, state, job, config, world)


def _candidates(config, nu, world, range_max, state, job):
    """Poses to rehearse from, ascending in k, the remembered one last."""
    rays, steps = job.ranges.size, 2**nu
    bearings = np.linspace(-np.pi, np.pi, rays * steps, endpoint=False)
    bearings = jnp.asarray(bearings, state.pose.dtype)
    fine = raycast(world, state.pose, bearings, range_max)
    if config.headings and config.orientation == "fourier_mellin":
        away = geometry.wrap(job.start[2] - state.pose[2])
        half = config.stray * config.box[1]
        found = distinct_headings(
            job.ranges, fine, away, half, config.headings, config.apart, job.mask
        )
    else:
        found = theseus(job.ranges, fine, config.orientation, job.mask)
    near = jnp.arange(len(found.corrections))
    beside = config.window >> nu
    if 2 * beside + 1 < len(near) and config.orientation != "first_principles":
        near = jnp.argmax(found.similarity) + jnp.arange(-beside, beside + 1)
        near = jnp.sort(near % steps)
    at = jnp.broadcast_to(state.pose[None, :2], (len(near), 2))
    poses = jnp.column_stack([at, state.pose[2] + found.corrections[near]])
    remembered = {
        "turn": state.pose + state.remembered,
        "heading": state.pose.at[2].set(state.remembered[2]),
        "pose": state.remembered,
    }[config.memory]
    poses = jnp.concatenate([poses, remembered[None]])
    poses = poses.at[:, 2].set(geometry.wrap(poses[:, 2]))
    return poses, jnp.append(found.similarity[near], 0.0)


def _finish(state, job, *, config, shared, range_max):
    """Gauss-Newton to the end."""
    world = job.world if shared is None else shared
    bearings = np.linspace(-np.pi, np.pi, job.ranges.size, endpoint=False)
    bearings = jnp.asarray(bearings, state.pose.dtype)
    limit = jnp.asarray(range_max, state.pose.dtype)
    valid = jnp.ones(job.ranges.shape, bool) if job.mask is None else job.mask
    scan = Scan(job.ranges, bearings, valid, valid & (job.ranges < limit), limit)
    fitted, _ = fit_ranges(world, scan, state.pose, config.finish, config.box[0])
    # What left the box slid along walls too close together: no measurement held it.
    held = ~strayed(config, fitted, job.start) & world.contains(fitted[:2])
    pose = jnp.where(held, fitted, state.pose)
    virtual = raycast(world, pose, bearings, limit)
    return state._replace(
        pose=pose,
        caer=caer_per_ray(job.ranges, virtual, valid),
        stage=state.stage + 1,
        scans=state.scans + config.finish + 1,
    )


def _recover_if(lost, state, job, config, world):
    """Start again from a pose in the box around the first estimate, inside the map."""
    again = lost & (state.recoveries < config.max_recoveries)
    done = len(config.levels) + (config.finish > 0)
    key, draw = jax.random.split(state.key)
    half = jnp.asarray([config.box[0], *config.box], state.pose.dtype)
    shift = jax.random.uniform(draw, (_DRAWS, 3), half.dtype, -1.0, 1.0)
    drawn = job.start[None] + shift * half[None]
    inside = world.contains(drawn[:, :2])
    fresh = jnp.where(jnp.any(inside), drawn[jnp.argmax(inside)], job.start)
    fresh = fresh.at[2].set(geometry.wrap(fresh[2]))
    forget = again & (config.memory == "pose")
    return state._replace(
        pose=jnp.where(again, fresh, state.pose),
        stage=jnp.where(again, 0, jnp.where(lost, done, state.stage)),
        counter=jnp.where(again, 0, state.counter),
        remembered=jnp.where(forget, fresh, state.remembered),
        recoveries=state.recoveries + again,
        key=key,
    )
