"""From about here to here: a scan of any field of view, a map, and a first estimate.

The engines want N rays over the full circle. `match` takes the scan as the sensor gave:

1. **panorama**: N equiangular rays, and a mask of those that the sensor knows;
2. **engine**: `fast_match`, ten virtual scans, or `fsmsm`, the thesis's method, turns
   and steps from the estimate to the pose; the type of the config says which;
3. **guard**: the pose must explain the scan, most rays of it, and no worse than the
   estimate did; else the estimate is given back;
4. **covariance**: what the scan's own rays, all of them, say about the pose.

Odometry, a person's click on the map or `localise` may give the estimate; the truth
should lie within the config's `box` around it. A ray without echo is information all
the same: both worlds, the real and the virtual, end at `range_max`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from fsmsm_jax.alignment.blocks import as_batch, cut, first, in_blocks, room_for
from fsmsm_jax.alignment.caer import caer_per_ray
from fsmsm_jax.alignment.fast import FastConfig, fast_match
from fsmsm_jax.alignment.first_estimate import (
    checked,
    into_the_open,
    one_world,
    strayed,
)
from fsmsm_jax.alignment.fit import polish_ranges
from fsmsm_jax.alignment.fsmsm import fsmsm
from fsmsm_jax.alignment.fsmsm_config import FsmsmConfig
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.sensing import Scan, panorama, raycast
from fsmsm_jax.sensing.buckets import filled, padded
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Match", "match", "match_batch"]

_AGREEING, _MOST = 0.3, 0.5  # [m] a ray may be off; share of the rays that are not
_CAN_MASK = "fourier_mellin"  # the method of FSMSM that can do without some rays
_KERNEL = 0.3  # [m] of the polish that finds the walls' thickness, as in `localise`


class Match(NamedTuple):
    """Where one scan was taken, given about where."""

    pose: Float[Array, "*batch 3"]
    """Pose [x, y, θ] of the sensor in the map frame [m, m, rad]; always finite."""
    covariance: Float[Array, "*batch 3 3"]
    """Its covariance, from the Fisher information of the ranges [m, m, rad]²."""
    caer_per_ray: Float[Array, "*batch"]
    """Mean |real − virtual range| over the scan's valid rays at `pose` [m]."""
    caer_before: Float[Array, "*batch"]
    """The same at the estimate that was given [m]."""
    agreement: Float[Array, "*batch"]
    """Share of the scan's valid rays that are within 0.3 m of the virtual ones."""
    converged: Bool[Array, "*batch"]
    """Whether anything was learned: a pose in the open, near the estimate, agrees with
    most rays. If not, `pose` is the estimate and `covariance` the box's."""
    iterations: Int[Array, "*batch"]
    """Steps taken from pose to pose, those of fresh starts included."""
    scans: Int[Array, "*batch"]
    """Virtual scans cast to find the pose."""


def match(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Sequence | np.ndarray | Array,
    config: FastConfig | FsmsmConfig = FastConfig(),
    *,
    rays: int = 360,
    key: PRNGKeyArray | None = None,
) -> Match:
    """Where was this scan taken, if it was taken about here?

    Args:
        world: the map.
        scan: one real scan, of any field of view and number of rays.
        pose: estimate [x, y, θ] of the sensor in the map frame [m, m, rad]. One that
            lies in a wall starts from the nearest place beside it.
        config: settings, and with them the method: `FastConfig()`, `FsmsmConfig()`, or
            `FsmsmConfig.published()` for the thesis's.
        rays: how many rays the panorama has; about as many as the sensor's per turn.
        key: for FSMSM's fresh starts from the box around the estimate.

    Returns:
        The pose and what to think of it; arrays on the device. Where every attempt
        left the map or the box, or ended with less than half of the rays in agreement
        or with more CAER than the estimate has (the guard that the thesis recommends),
        `converged` is False and the estimate is given back, with the covariance of a
        pose anywhere in the box.

    Raises:
        ValueError: the estimate is not three finite numbers, or nothing in the box
            around it is open space of the map; the scan has fewer than 10 echoes; some
            rays are missing and the method needs all; fewer than 8 rays are asked for.

    Example:
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [2, 4]])
        >>> bearings = jnp.linspace(-2.0, 2.0, 120)  # 229° of the room
        >>> ranges = raycast(room, jnp.array([3.0, 2.0, 0.5]), bearings)
        >>> scan = Scan.from_bearings(ranges, bearings)
        >>> found = match(room, scan, [3.1, 1.9, 0.2], rays=180)
        >>> [round(v, 2) for v in found.pose.tolist()], bool(found.converged)
        ([3.0, 2.0, 0.5], True)

    Note:
        Compiled once per shape of map and bucket of rays (`sensing.buckets`), whatever
        the numbers in them or in the config; batches up to 64 once per power of two.
        Not differentiable, and not for `vmap`: see `match_batch`.
    """
    if np.ndim(scan.ranges) != 1:
        raise ValueError(
            f"expected a scan with (rays,) ranges, got shape {np.shape(scan.ranges)}; "
            "match takes one scan, match_batch many"
        )
    if not one_world(world):
        raise ValueError("expected one map, got many; match_batch takes those")
    if np.shape(pose) != (3,):
        raise ValueError(
            f"a pose is [x, y, θ], three numbers [m, m, rad]; got {np.shape(pose)}"
        )
    poses = np.asarray(pose, float)[None]
    scans = as_batch(padded(scan))
    found = match_batch(world, scans, poses, config, rays=rays, key=key)
    return first(found)


def match_batch(
    worlds: OccupancyGrid | PolygonMap,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    config: FastConfig | FsmsmConfig = FastConfig(),
    *,
    rays: int = 360,
    key: PRNGKeyArray | None = None,
) -> Match:
    """`match` for many scans of one sensor in one call.

    Args:
        worlds: one map for all, or a pytree of maps with a leading axis.
        scans: scans stacked along a leading axis
            (`jax.tree.map(lambda *a: jnp.stack(a), *list_of_scans)`).
        poses: (scans, 3) estimates, each as in `match`.
        config: as in `match`.
        rays: as in `match`.
        key: as in `match`; each scan draws from a key of its own.

    Returns:
        A `Match` whose arrays have the same leading axis.

    Raises:
        ValueError: as `match`, for any of the scans; the number of scans, poses and
            maps differs; the scans differ in `range_max`.
    """
    given = checked(worlds, scans, poses, rays)
    # Few shapes: rays that say nothing, and the last scan again, fill the batch up.
    count, room = len(given), room_for(len(given))
    scans, given = jax.device_put(filled((padded(scans), given), room))
    worlds = worlds if one_world(worlds) else jax.device_put(filled(worlds, room))
    starts = into_the_open(worlds, given, config.box)
    panoramas = _panoramas(scans, rays)
    if isinstance(config, FsmsmConfig) and config.orientation != _CAN_MASK:
        missing = int(np.max(np.sum(~np.asarray(panoramas.valid), axis=-1)))
        if missing:
            raise ValueError(
                f"{config.orientation!r} needs every ray, but {missing} of {rays} are "
                f"missing; orientation={_CAN_MASK!r} can do without them"
            )
    found = None
    if isinstance(config, FsmsmConfig):
        key = jax.random.key(0) if key is None else key
        found = _by_fsmsm(worlds, scans, panoramas, starts, config, key)
    shared = worlds if one_world(worlds) else None
    own = None if one_world(worlds) else worlds
    jobs = (own, scans, panoramas, given, starts, found)
    found = in_blocks(lambda block: _match(shared, block, config), jobs, room)
    return cut(found, count)


_panoramas = jax.jit(jax.vmap(panorama, (0, None)), static_argnums=1)


@jax.jit
def _by_fsmsm(worlds, scans, panoramas, starts, config, key):
    return fsmsm(
        worlds,
        panoramas.ranges,
        starts,
        config,
        # Full or not: one program for both. Some methods know no masks.
        mask=panoramas.valid if config.orientation == _CAN_MASK else None,
        range_max=scans.range_max[0],
        key=key,
    )


@jax.jit
def _match(shared, jobs, config):
    """Pose, verdict and covariance of a block of scans."""

    def one(job):
        world, scan, panorama, given, start, found = job
        world = world if shared is None else shared
        if isinstance(config, FastConfig):
            pose, thickness = fast_match(world, scan, panorama, start, config)
            learned = world.contains(pose[:2]) & ~strayed(config, pose, given)
            steps, scans = 1 + config.looks + config.finish, config.scans
        else:
            pose, learned = found.pose, found.converged
            thickness = _thickness(world, scan, pose)
            steps, scans = found.steps, found.scans
        compare = lambda pose: _compare(world, scan, pose)
        caers, agreements = jax.vmap(compare)(jnp.stack([given, pose]))
        (before, caer), (agreed, agreement) = caers, agreements
        learned &= (caer <= before) & (agreement >= _MOST)
        spread = covariance(world, scan, pose, thickness)
        half = jnp.stack([config.box[0], *config.box]).astype(pose.dtype)
        return Match(
            pose=jnp.where(learned, pose, given),
            covariance=jnp.where(learned, spread, jnp.diag(half**2 / 3)),
            caer_per_ray=jnp.where(learned, caer, before),
            caer_before=before,
            agreement=jnp.where(learned, agreement, agreed),
            converged=learned,
            iterations=jnp.asarray(steps, int),
            scans=jnp.asarray(scans, int),
        )

    return jax.vmap(one)(jobs)


def _thickness(world, scan, pose):
    """How much nearer than the real walls a grid draws them [m]."""
    if isinstance(world, PolygonMap):
        return jnp.zeros((), pose.dtype)
    return polish_ranges(world, scan, pose, jnp.full(2, _KERNEL, pose.dtype))[1]


def _compare(world, scan, pose):
    """CAER per ray [m], and the share of the rays that agree."""
    virtual = raycast(world, pose, scan.bearings, scan.range_max)
    agreeing = jnp.abs(scan.ranges - virtual) <= _AGREEING
    share = jnp.sum(agreeing & scan.valid) / jnp.maximum(jnp.sum(scan.valid), 1)
    return caer_per_ray(scan.ranges, virtual, scan.valid), share
