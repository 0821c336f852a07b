"""What a match starts from: sound scans, finite estimates, and a place in the open.

An estimate from odometry or from a click on the map may lie in a wall, from where
nothing is to be seen. `into_the_open` moves it to the nearest place beside.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fast import FastConfig
from fsmsm_jax.alignment.fsmsm_config import FsmsmConfig
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["check_scans", "checked", "into_the_open", "one_world", "strayed"]

_FEWEST_RAYS = 8  # of a panorama: a heading and a first harmonic need some
_FEWEST_ECHOES = 10  # three numbers are wanted, and some rays hit what is not drawn
_SIDE = 11  # positions tried along a side of the box, to find one in the open


def checked(
    worlds: OccupancyGrid | PolygonMap | None,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    rays: int,
) -> Float[Array, "scans 3"]:
    """The poses as an array, headings wrapped, if all inputs are sound.

    Without `worlds`, scans and poses only.

    Raises:
        ValueError: what `match_batch` says of its input.
    """
    check_scans(scans)
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
    if worlds is not None and not one_world(worlds):
        maps = len(jax.tree.leaves(worlds)[0])
        if maps != count:
            raise ValueError(f"expected one map or one a scan ({count}), got {maps}")
    poses[:, 2] = np.mod(poses[:, 2] + np.pi, 2 * np.pi) - np.pi
    return jax.device_put(poses.astype(scans.ranges.dtype))  # no program, see blocks


def check_scans(scans: Scan) -> None:
    """Refuse a batch of scans that nothing can be matched with.

    Raises:
        ValueError: no batch or an empty one, more than one `range_max`, or hardly
            an echo.
    """
    if np.ndim(scans.ranges) != 2 or len(scans.ranges) == 0:
        raise ValueError(
            f"expected scans with (scans, rays) ranges, got {np.shape(scans.ranges)}; "
            "functions that end in _batch take many scans, the others one"
        )
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


def into_the_open(
    worlds: OccupancyGrid | PolygonMap,
    poses: Float[Array, "scans 3"],
    box: tuple[ScalarLike, ScalarLike],
) -> Float[Array, "scans 3"]:
    """Each pose, or the nearest within the box [m, rad] that is not in an obstacle.

    Raises:
        ValueError: there is none.
    """
    starts, open_space = _nearest_open(worlds, poses, box)
    if not np.all(open_space):
        n = int(np.argmin(open_space))
        raise ValueError(
            f"pose {n}, {np.asarray(poses[n]).tolist()}, is off the map or inside a "
            f"wall, and so is all within {np.asarray(box[0]):g} m of it; is it "
            "the sensor's pose in the map frame, in metres and radians?"
        )
    return starts


@jax.jit
def _nearest_open(worlds, poses, box):
    """Of the places in the box, the nearest in the open; and whether there is any."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, _SIDE)] * 2)
    shifts = np.stack([x.ravel(), y.ravel()], axis=-1)
    shifts = shifts[np.argsort(np.hypot(*shifts.T), kind="stable")]
    shifts = box[0] * jnp.asarray(shifts, poses.dtype)

    def one(world, pose):
        inside = world.contains(pose[None, :2] + shifts)
        nearest = shifts[jnp.argmax(inside)]
        return pose.at[:2].add(nearest), jnp.any(inside)

    shared = None if one_world(worlds) else 0
    return jax.vmap(one, (shared, 0))(worlds, poses)


def one_world(worlds: OccupancyGrid | PolygonMap) -> bool:
    """Whether a map is a single one, and not many along a leading axis."""
    if isinstance(worlds, PolygonMap):
        return np.ndim(worlds.start) == 2
    return np.ndim(worlds.cells) == 2


def strayed(
    config: FastConfig | FsmsmConfig,
    pose: Float[Array, "3"],
    start: Float[Array, "3"],
) -> Bool[Array, ""]:
    """Whether a pose lies too many boxes away from the first estimate, or nowhere."""
    away = jnp.abs(pose - start)
    turn = jnp.abs(geometry.wrap(away[2]))
    near = jnp.all(away[:2] <= config.stray * config.box[0])
    return ~(near & (turn <= config.stray * config.box[1]))
