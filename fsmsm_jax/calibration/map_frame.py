r"""A map whose metre is too long, or that lies elsewhere than it says.

A map drawn from a plan, or by a robot with worn wheels, has a scale s; one that was
cropped or re-made has another origin. Point p of the map as drawn really lies at

$$c + t + s R(\psi) (p - c)$$

with pivot c in the midst of the scans. Not the map is changed to find out but the
question: the range from a true pose is s times the range that the drawn map shows from
the pose brought back into it. So one ray cast, with its exact derivative, serves every
scale, on grids and polygons alike.

The scans by themselves tell the scale: a room is as wide as its ranges say. Where the
map lies only the poses can tell, if they come from outside the map (surveyed, or from
another map). An error that all of them share is one with the origin's, and a sensor
whose metre is wrong is one with a map whose metre is (`range_correction`): one of the
two has to be trusted.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.calibration.inputs import across_walls, check, determined, thinned
from fsmsm_jax.calibration.separable import Linearised, solve
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["MapFrame", "corrected", "map_frame"]

_SPREAD = (0.2, 1.0, 1.0, 0.5)  # of scale [share] and shift [m, m, rad], as drawn
_SIGMA = 0.1  # [m] of a residual while the map is still wrong


class MapFrame(NamedTuple):
    """How a map lies in the frame of the poses."""

    scale: Float[Array, ""]
    """True metres to a drawn one."""
    shift: Float[Array, "3"]
    """[x, y, ψ] by which the map has to move and turn about the pivot [m, m, rad]."""
    pivot: Float[Array, "2"]
    """The point c of the drawn map that the shift is about [m]."""
    covariance: Float[Array, "4 4"]
    """Of [scale, x, y, ψ], over the scans."""
    std: Float[Array, "4"]
    """Its standard deviations [share, m, m, rad]."""
    determined: Bool[Array, "4"]
    """Whether the scans and poses tell scale, x, y, ψ."""
    poses: Float[Array, "scans 3"]
    """The poses, as the scans see them in the map as corrected [m, m, rad]."""
    residual: Float[Array, ""]
    """Standard deviation of a ray's residual, by the median [m]."""
    converged: Bool[Array, ""]
    """Whether the last step was small, against the deviations."""


def map_frame(
    world: OccupancyGrid | PolygonMap,
    scans: Scan,
    poses: Sequence | np.ndarray | Array,
    pose_std: Sequence | np.ndarray | Array = (0.02, 0.02, 0.01),
    *,
    rays: int = 180,
    steps: int = 12,
) -> MapFrame:
    """Scale and place of a map, from scans at poses that are about known.

    Args:
        world: the map as drawn, wrong by some percent and some decimetres.
        scans: at least 3 scans, stacked along a leading axis.
        poses: (scans, 3) poses [x, y, θ] of the lidar in the *true* frame [m, m, rad].
        pose_std: standard deviations of these [m, m, rad]. Infinite ones leave the
            poses free: then the scale is found and the shift is not `determined`.
        rays: about how many rays of a scan to use.
        steps: Gauss-Newton steps.

    Returns:
        Scale and shift; `corrected` applies them to the map.

    Raises:
        ValueError: the scans are not stacked, are fewer than 3, or one has fewer than
            10 echoes; the poses are of a wrong shape or not finite; a deviation is not
            positive.

    Note:
        On a grid whose walls are drawn thick every range is some centimetres short,
        which in a small room looks like a small scale. Not differentiable.
    """
    poses = check(scans, poses, 3)
    pose_std = np.asarray(pose_std, float)
    if pose_std.shape != (3,) or not (pose_std > 0).all():
        raise ValueError(
            f"pose_std must be three positive deviations [m, m, rad], got {pose_std}"
        )
    scans = thinned(scans, rays)
    return _map_frame(world, scans, poses, jnp.asarray(pose_std, poses.dtype), steps)


@eqx.filter_jit
def _map_frame(world, scans, poses, pose_std, steps):
    pivot = jnp.mean(poses[:, :2], axis=0)

    def drawn(pose, shared):
        """A true pose, where the drawn map has it."""
        moved = jnp.append(pivot + shared[1:3], shared[3])
        there = geometry.between(moved, pose)
        return there.at[:2].set(pivot + there[:2] / shared[0])

    def linearise(scan, pose, shared):
        scale = shared[0]
        there = drawn(pose, shared)
        small = Scan(
            scan.ranges / scale,
            scan.bearings,
            scan.valid,
            scan.echo,
            scan.range_max / scale,
        )
        (e, J, known), slant = across_walls(world, small, there)
        by_pose, by_shared = jax.jacfwd(drawn, (0, 1))(pose, shared)
        J = scale * J @ jnp.concatenate([by_pose, by_shared], axis=1)
        J = J.at[:, 3].add(small.ranges - e)  # the virtual range itself
        return Linearised(scale * e / slant, J / slant[:, None], known)

    first = jnp.array([1.0, 0.0, 0.0, 0.0], poses.dtype)
    spread = jnp.asarray(_SPREAD, poses.dtype)
    found = solve(
        linearise, scans, poses, first, spread, _SIGMA, steps, pose_spread=pose_std
    )
    return MapFrame(
        scale=found.shared[0],
        shift=found.shared[1:].at[2].set(geometry.wrap(found.shared[3])),
        pivot=pivot,
        covariance=found.covariance,
        std=jnp.sqrt(jnp.diag(found.covariance)),
        determined=determined(found.covariance, spread),
        poses=found.poses,
        residual=found.sigma,
        converged=found.converged,
    )


def corrected(
    world: OccupancyGrid | PolygonMap, frame: MapFrame
) -> OccupancyGrid | PolygonMap:
    """The map in its true metre and place.

    Example:
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> still = jnp.zeros(3)
        >>> frame = MapFrame(jnp.array(2.0), still, jnp.ones(2), *[jnp.zeros(())] * 6)
        >>> corrected(room, frame).end[0].tolist()
        [9.0, 1.0]
    """
    moved = jnp.append(frame.pivot + frame.shift[:2], frame.shift[2])
    to_pivot = jnp.append(-frame.pivot, 0.0)
    place = lambda points: geometry.transform_points(
        moved, frame.scale * geometry.transform_points(to_pivot, points)
    )
    if isinstance(world, PolygonMap):
        return PolygonMap(place(world.start), place(world.end), world.solid)
    origin = jnp.append(
        place(world.origin[:2]), geometry.wrap(world.origin[2] + frame.shift[2])
    )
    return eqx.tree_at(
        lambda grid: (grid.resolution, grid.distance, grid.origin),
        world,
        (frame.scale * world.resolution, frame.scale * world.distance, origin),
    )
