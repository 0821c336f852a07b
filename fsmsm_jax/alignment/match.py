"""From about here to here: a scan of any field of view, a map, and a first estimate.

`fsmsm` wants N rays over the full circle. `match` takes the scan as the sensor gave it:

1. **panorama**: N equiangular rays, and a mask of those that the sensor knows;
2. **fsmsm**: turns and steps from the estimate to the pose;
3. **guard**: the pose must explain the scan, most rays of it, and no worse than the
   estimate did; else the estimate is given back;
4. **covariance**: what the scan's own rays, all of them, say about the pose.

Odometry, a person's click on the map or `localise` may give the estimate; the truth
should lie within the box of `FsmsmConfig.box` around it. A ray without echo is
information all the same: both worlds, the real and the virtual, end at `range_max`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from fsmsm_jax.alignment.caer import caer_per_ray
from fsmsm_jax.alignment.fit import polish_ranges
from fsmsm_jax.alignment.fsmsm import fsmsm
from fsmsm_jax.alignment.fsmsm_config import FsmsmConfig
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.sensing import Scan, panorama, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Match", "match", "match_batch"]

_FEWEST_RAYS = 8  # of a panorama: a heading and a first harmonic need some
_FEWEST_ECHOES = 10  # three numbers are wanted, and some rays hit what is not drawn
_AGREEING, _MOST = 0.3, 0.5  # [m] a ray may be off; share of the rays that are not
_TOGETHER = 16  # scans whose covariances are computed at once
_SIDE = 11  # positions tried along a side of the box, to find one in the open
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
    """Outer steps taken, those of fresh starts included."""
    scans: Int[Array, "*batch"]
    """Virtual scans cast."""


def match(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Sequence | np.ndarray | Array,
    config: FsmsmConfig = FsmsmConfig(),
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
        config: settings; `FsmsmConfig.published()` for the thesis's.
        rays: how many rays the panorama has; about as many as the sensor's per turn.
        key: for fresh starts from the box around the estimate.

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
        Compiled once per shape of map and scan, whatever the numbers in them or in
        the config. Not differentiable, and not for `vmap`: see `match_batch`.
    """
    if np.ndim(scan.ranges) != 1:
        raise ValueError(
            f"expected a scan with (rays,) ranges, got shape {np.shape(scan.ranges)}; "
            "match takes one scan, match_batch many"
        )
    if not _one_world(world):
        raise ValueError("expected one map, got many; match_batch takes those")
    if np.shape(pose) != (3,):
        raise ValueError(
            f"a pose is [x, y, θ], three numbers [m, m, rad]; got {np.shape(pose)}"
        )
    scans = jax.tree.map(lambda a: a[None], scan)
    poses = np.asarray(pose, float)[None]
    found = match_batch(world, scans, poses, config, rays=rays, key=key)
    return jax.tree.map(lambda a: a[0], found)


def match_batch(
    worlds: OccupancyGrid | PolygonMap,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    config: FsmsmConfig = FsmsmConfig(),
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
    poses = _check(worlds, scans, poses, rays)
    starts, open_space = _into_the_open(worlds, poses, config.box)
    if not np.all(open_space):
        n = int(np.argmin(open_space))
        raise ValueError(
            f"pose {n}, {np.asarray(poses[n]).tolist()}, is off the map or inside a "
            f"wall, and so is all within {np.asarray(config.box[0]):g} m of it; is it "
            "the sensor's pose in the map frame, in metres and radians?"
        )
    panoramas = _panoramas(scans, rays)
    mask = panoramas.valid  # full or not: one program for both
    if config.orientation != "fourier_mellin":
        missing = int(np.max(np.sum(~np.asarray(mask), axis=-1)))
        if missing:
            raise ValueError(
                f"{config.orientation!r} needs every ray, but {missing} of {rays} are "
                "missing; orientation='fourier_mellin' can do without them"
            )
        mask = None
    key = jax.random.key(0) if key is None else key
    return _match(worlds, scans, panoramas.ranges, mask, poses, starts, config, key)


def _one_world(world):
    """Whether the pytree is a single map, and not many along a leading axis."""
    single = {OccupancyGrid: "cells", PolygonMap: "start"}[type(world)]
    return np.ndim(getattr(world, single)) == 2


def _check(worlds, scans, poses, rays):
    """The poses as an array, if all inputs are sound."""
    if np.ndim(scans.ranges) != 2:
        raise ValueError(
            f"expected scans with (scans, rays) ranges, got {np.shape(scans.ranges)}; "
            "match_batch takes many scans, match one"
        )
    if rays < _FEWEST_RAYS:
        raise ValueError(
            f"a panorama needs at least {_FEWEST_RAYS} rays to match, got {rays}"
        )
    count = len(scans.ranges)
    poses = np.array(poses, float)
    if poses.shape != (count, 3) or count == 0:
        raise ValueError(
            f"expected one pose [x, y, θ] a scan, shape ({count}, 3) for {count} "
            f"scans, got {poses.shape}"
        )
    if not np.isfinite(poses).all():
        n = int(np.argmin(np.isfinite(poses).all(axis=1)))
        raise ValueError(
            f"pose {n} is {poses[n].tolist()}; a match starts from finite numbers. "
            "Without an estimate, `localise` finds one"
        )
    if not _one_world(worlds):
        maps = len(jax.tree.leaves(worlds)[0])
        if maps != count:
            raise ValueError(f"expected one map or one a scan ({count}), got {maps}")
    limits = np.asarray(scans.range_max)
    if np.ptp(limits) > 0:
        raise ValueError(
            f"the scans of a batch share one range_max, got {limits.min():g} to "
            f"{limits.max():g} m; match each sensor's scans apart"
        )
    echoes = np.sum(np.asarray(scans.echo), axis=-1)
    if np.min(echoes) < _FEWEST_ECHOES:
        raise ValueError(
            f"scan {int(np.argmin(echoes))} has {np.min(echoes)} echoes, but it takes "
            f"at least {_FEWEST_ECHOES} to say where they are seen from; check "
            "range_max and units"
        )
    poses[:, 2] = np.mod(poses[:, 2] + np.pi, 2 * np.pi) - np.pi
    return jnp.asarray(poses, scans.ranges.dtype)


@jax.jit
def _into_the_open(worlds, poses, box):
    """Of the places in the box, the nearest in the open; and whether there is any."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, _SIDE)] * 2)
    shifts = np.stack([x.ravel(), y.ravel()], axis=-1)
    shifts = shifts[np.argsort(np.hypot(*shifts.T), kind="stable")]
    shifts = box[0] * jnp.asarray(shifts, poses.dtype)

    def one(world, pose):
        inside = world.contains(pose[None, :2] + shifts)
        nearest = shifts[jnp.argmax(inside)]
        return pose.at[:2].add(nearest), jnp.any(inside)

    shared = None if _one_world(worlds) else 0
    return jax.vmap(one, (shared, 0))(worlds, poses)


_panoramas = jax.jit(jax.vmap(panorama, (0, None)), static_argnums=1)


@jax.jit
def _match(worlds, scans, ranges, mask, poses, starts, config, key):
    limit = scans.range_max[0]
    found = fsmsm(worlds, ranges, starts, config, mask=mask, range_max=limit, key=key)
    shared = worlds if _one_world(worlds) else None

    def judge(job):
        world, scan, given, pose, converged = job
        world = world if shared is None else shared
        before, agreed = _compare(world, scan, given)
        caer, agreement = _compare(world, scan, pose)
        learned = converged & (caer <= before) & (agreement >= _MOST)
        spread = covariance(world, scan, pose, _thickness(world, scan, pose))
        half = jnp.stack([config.box[0], *config.box]).astype(pose.dtype)
        return Match(
            pose=jnp.where(learned, pose, given),
            covariance=jnp.where(learned, spread, jnp.diag(half**2 / 3)),
            caer_per_ray=jnp.where(learned, caer, before),
            caer_before=before,
            agreement=jnp.where(learned, agreement, agreed),
            converged=learned,
            iterations=jnp.zeros((), int),
            scans=jnp.zeros((), int),
        )

    own = worlds if shared is None else None
    jobs = (own, scans, poses, found.pose, found.converged)
    judged = jax.lax.map(judge, jobs, batch_size=_TOGETHER)
    return judged._replace(iterations=found.steps, scans=found.scans)


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
