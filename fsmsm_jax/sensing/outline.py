"""A scan as a world: what was seen from one place, to be looked at from another.

The end points of a scan, joined in order, enclose the space that its rays have crossed.
For the thesis that polygon is the world in which the next scan is matched. But it ends
in two ways. Between neighbouring echoes on one surface stands a wall. Elsewhere, from a
pole to the room behind it, along the last ray of a 180° sensor, where no echo came,
only sight ended: there is a veil (`PolygonMap.solid`), and a ray that gets there first
learns nothing, instead of a wall that nobody saw. Rays that are invalid have seen
nothing, so their end points are the sensor itself: a 180° scan is half a disc, whose
straight side is a veil.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.surfaces import Surfaces, surfaces
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["closed_outline", "seen_space"]


def seen_space(panorama: Scan, walls: Surfaces | None = None) -> PolygonMap:
    """The space that a scan has seen, in its own frame: walls and veils.

    Args:
        panorama: N equiangular rays over the full circle (`sensing.panorama`).
        walls: what `surfaces` says of it; asked here if left out.

    Returns:
        N segments, from the end of each ray to the end of the next, without the noise
        where a wall was made out.

    Example:
        >>> import numpy as np
        >>> from fsmsm_jax import panorama, raycast
        >>> ahead = Scan.from_ranges(np.full(181, 2.0), -np.pi / 2, np.pi / 180)
        >>> world = seen_space(panorama(ahead, 360))
        >>> ranges = raycast(world, jnp.array([-0.5, 0.0, 0.0]), jnp.array([0.0, 3.0]))
        >>> ranges.round(2).tolist()  # the wall ahead; behind, nobody knows
        [2.5, 30.0]
    """
    walls = surfaces(panorama) if walls is None else walls
    ranges = jnp.where(panorama.valid, walls.ranges, 0.0)
    ends = _ends(ranges, panorama.bearings)
    return PolygonMap(ends, jnp.roll(ends, -1, axis=0), walls.solid)


def closed_outline(panorama: Scan) -> PolygonMap:
    """The end points as measured, all joined by walls: the world of the thesis's FSM.

    For scans that are echoes all around; else `seen_space`.

    Reference:
        Algorithm XXIV of the thesis, line 2.
    """
    ends = _ends(panorama.ranges, panorama.bearings)
    return PolygonMap(ends, jnp.roll(ends, -1, axis=0))


def _ends(
    ranges: Float[Array, "rays"], bearings: Float[Array, "rays"]
) -> Float[Array, "rays 2"]:
    return ranges[:, None] * jnp.stack([jnp.cos(bearings), jnp.sin(bearings)], axis=-1)
