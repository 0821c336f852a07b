"""Occupancy grids: the maps that robots make, ready for ray casting.

A grid is a picture of the world in square cells. Each cell is free, occupied or
unknown, kept as ROS keeps it: −1 unknown, else the occupancy in percent. Row 0
is the *bottom* of the map and column 0 its left, so `cells[row, column]` covers
[column, column + 1) × [row, row + 1) in cell units. `origin` is the pose of the
grid's lower left corner in the map frame, yaw included: the grid may lie turned
in the map.

Three fields are computed once, on the host, when a grid is made:
`clearance` (how many cells a ray may safely jump), `distance` (metres to the
nearest occupied cell: end points of a scan should find it small) and `slope`
(gradient of the blurred occupancy, along the wall's normal).
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int8, UInt8
from scipy import ndimage

from fsmsm_jax import geometry

__all__ = ["OccupancyGrid"]

_OCCUPIED_PERCENT = 50
_BLUR = 1.5  # [cells]: wide enough that stair-steps of a slanted wall vanish


class OccupancyGrid(eqx.Module):
    """A grid map; build one with `OccupancyGrid.from_cells` or `load_map`."""

    cells: Int8[Array, "height width"]
    """Occupancy in percent, −1 where unknown; row 0 at the bottom."""
    resolution: Float[Array, ""]
    """Side of a cell [m]."""
    origin: Float[Array, "3"]
    """Pose of the lower left corner of `cells` in the map frame [m, m, rad]."""
    clearance: UInt8[Array, "height+2 width+2"]
    """Chessboard distance to the nearest cell that stops a ray [cells, at most 255].

    Padded by one ring of zeros: a ray that reaches the ring has left the map.
    """
    distance: Float[Array, "height width"]
    """Distance from the cell's centre to the nearest occupied cell's centre [m]."""
    slope: Float[Array, "height width 2"]
    """Gradient of the blurred occupancy along columns and rows, in the grid's frame;
    downhill is the wall's normal."""

    @classmethod
    def from_cells(
        cls,
        cells: Sequence | np.ndarray | Array,
        resolution: float,
        origin: Sequence | np.ndarray | Array = (0.0, 0.0, 0.0),
        *,
        unknown: str = "transparent",
    ) -> "OccupancyGrid":
        """Make a grid from ROS occupancy values.

        Args:
            cells: (height, width) integers: −1 unknown, 0 to 100 per cent occupied
                (50 and more stops rays); row 0 is the bottom of the map.
            resolution: side of a cell [m].
            origin: pose of the lower left corner in the map frame [m, m, rad].
            unknown: "transparent" lets rays through unknown space, "opaque"
                stops them there.

        Raises:
            ValueError: the array is not a two-dimensional map with values in
                −1..100, the resolution is not positive, the origin is not three
                finite numbers, or `unknown` is another word.
        """
        cells = np.asarray(cells)
        if cells.ndim != 2 or cells.size == 0:
            raise ValueError(
                f"cells must be a non-empty (height, width) array, got {cells.shape}"
            )
        if not (np.isfinite(cells).all() and cells.min() >= -1 and cells.max() <= 100):
            raise ValueError(
                "cells must lie in −1 (unknown), 0..100 (per cent occupied)"
            )
        if not (np.isfinite(resolution) and resolution > 0):
            raise ValueError(
                f"resolution must be a positive number of metres, got {resolution}"
            )
        if np.shape(origin) != (3,) or not np.isfinite(np.asarray(origin, float)).all():
            raise ValueError(
                f"origin must be three finite numbers [x, y, yaw], got {origin}"
            )
        if unknown not in ("transparent", "opaque"):
            raise ValueError(
                f"unknown must be 'transparent' or 'opaque', got {unknown!r}"
            )

        occupied = cells >= _OCCUPIED_PERCENT
        stops = occupied | (cells < 0) if unknown == "opaque" else occupied
        clearance = ndimage.distance_transform_cdt(
            ~np.pad(stops, 1, constant_values=True), metric="chessboard"
        )
        if occupied.any():
            distance = (
                np.asarray(ndimage.distance_transform_edt(~occupied)) * resolution
            )
        else:
            distance = np.full(cells.shape, np.hypot(*cells.shape) * resolution)
        blurred = ndimage.gaussian_filter(occupied.astype(np.float32), _BLUR)
        along = [ndimage.correlate1d(blurred, [-1, 0, 1], axis) for axis in (1, 0)]
        slope = np.stack(along, axis=-1)
        return cls(
            cells=jnp.asarray(cells, jnp.int8),
            resolution=jnp.asarray(resolution, float),
            origin=jnp.asarray(origin, float),
            clearance=jnp.asarray(np.minimum(np.asarray(clearance), 255), jnp.uint8),
            distance=jnp.asarray(distance, float),
            slope=jnp.asarray(slope, float),
        )

    @property
    def occupied(self) -> Bool[Array, "height width"]:
        """Cells that hold an obstacle."""
        return self.cells >= _OCCUPIED_PERCENT

    @property
    def free(self) -> Bool[Array, "height width"]:
        """Cells known to be empty: neither occupied nor unknown."""
        return (self.cells >= 0) & (self.cells < _OCCUPIED_PERCENT)

    @property
    def unknown(self) -> Bool[Array, "height width"]:
        """Cells nobody has looked at."""
        return self.cells < 0

    def to_cells(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Map-frame points [m] in (column, row) units; cell (0, 0) covers [0, 1)²."""
        return (
            geometry.transform_points(geometry.inverse(self.origin), points)
            / self.resolution
        )

    def to_map(self, cells: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """(column, row) units, 0.5 being a cell's centre, as map-frame points [m]."""
        return geometry.transform_points(self.origin, cells * self.resolution)

    def distance_at(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
        """Distance [m] from map-frame points to the nearest obstacle, interpolated.

        Differentiable; points off the map take the value of the nearest edge.
        """
        height, width = self.cells.shape
        x, y = jnp.moveaxis(self.to_cells(points) - 0.5, -1, 0)
        x, y = jnp.clip(x, 0, width - 1.001), jnp.clip(y, 0, height - 1.001)
        i, j = x.astype(int), y.astype(int)
        u, v = x - i, y - j
        lower = (1 - u) * self.distance[j, i] + u * self.distance[j, i + 1]
        upper = (1 - u) * self.distance[j + 1, i] + u * self.distance[j + 1, i + 1]
        return (1 - v) * lower + v * upper

    def contains(self, points: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
        """Whether map-frame points [m] lie on the map and not in an obstacle."""
        cell, inside = self._cell_at(points)
        return inside & (cell < _OCCUPIED_PERCENT)

    def unknown_at(self, points: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
        """Whether map-frame points [m] lie in unknown cells or off the map."""
        cell, inside = self._cell_at(points)
        return ~inside | (cell < 0)

    def _cell_at(self, points):
        """Each point's cell, the nearest one if it is off the map, and if it is on."""
        height, width = self.cells.shape
        column, row = jnp.moveaxis(jnp.floor(self.to_cells(points)).astype(int), -1, 0)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return self.cells[row.clip(0, height - 1), column.clip(0, width - 1)], inside
