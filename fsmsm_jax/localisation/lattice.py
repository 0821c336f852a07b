"""Where a sensor may stand: a square lattice over a map's free space.

The lattice turns with the map, so that its nodes keep their place in the building
whatever frame the map is given in. A node is allowed when free space is at hand; in
unknown space a sensor may stand too, a little way in, for map makers do not enter
every corner that robots do.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from fsmsm_jax import geometry
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["Lattice", "lattice_over"]


class Lattice(eqx.Module):
    """A square lattice of positions; node (row, column) is a place to stand."""

    frame: Float[Array, "3"]
    """Pose of the lattice's lower left corner in the map [m, m, rad]."""
    spacing: float = eqx.field(static=True)
    """Distance between nodes [m]; node (0, 0) lies half of it inside the corner."""

    def to_map(
        self, row: Int[Array, "*batch"], column: Int[Array, "*batch"]
    ) -> Float[Array, "*batch 2"]:
        """Map-frame position [m] of nodes."""
        offset = (jnp.stack([column, row], axis=-1) + 0.5) * self.spacing
        return geometry.transform_points(self.frame, offset)


def lattice_over(
    world: OccupancyGrid | PolygonMap, spacing: float, margin: float
) -> tuple[Lattice, Bool[np.ndarray, "rows columns"]]:
    """The lattice over the known part of a map, and its nodes where one may stand.

    Args:
        world: the map.
        spacing: distance between nodes [m].
        margin: how far into a grid's unknown space a sensor may stand [m].

    Raises:
        ValueError: no node lies in free space.
    """
    if isinstance(world, OccupancyGrid):
        frame, size, may_stand = _over_grid(world, spacing, margin)
    else:
        ends = np.concatenate([world.start, world.end])
        frame = jnp.asarray([*ends.min(axis=0), 0.0], float)
        size, may_stand = np.ptp(ends, axis=0), world.contains
    columns, rows = np.maximum(np.ceil(size / spacing - 1e-6).astype(int), 1)
    lattice = Lattice(frame, spacing)
    allowed = np.asarray(may_stand(lattice.to_map(*jnp.indices((rows, columns)))))
    if not allowed.any():
        raise ValueError(
            f"no lattice position of spacing {spacing} m lies in free space; choose a "
            "smaller spacing, or check the map's thresholds if none of it is free"
        )
    return lattice, allowed


def _over_grid(world, spacing, margin):
    """Frame, size [m] and standing room of the smallest rectangle of known cells."""
    free, known = np.asarray(world.free), ~np.asarray(world.unknown)
    if not known.any():
        raise ValueError("the map has no known cell; check its thresholds")
    resolution = float(world.resolution)
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    corner = np.array([columns[0], rows[0]]) * resolution
    size = (np.array([columns[-1], rows[-1]]) + 1) * resolution - corner
    frame = geometry.compose(world.origin, jnp.asarray([*corner, 0.0], float))

    to_free = np.asarray(ndimage.distance_transform_edt(~free)) * resolution
    if not free.any():
        to_free = np.full(free.shape, np.inf)
    stand = (to_free <= spacing / 2) | (~known & (to_free <= margin))

    def may_stand(points):
        cell = np.floor(np.asarray(world.to_cells(points))).astype(int)
        column, row = np.moveaxis(cell, -1, 0)
        height, width = (int(side) for side in world.extent)
        on_map = (0 <= row) & (row < height) & (0 <= column) & (column < width)
        return on_map & stand[row.clip(0, height - 1), column.clip(0, width - 1)]

    return frame, size, may_stand
