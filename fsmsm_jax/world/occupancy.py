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
(gradient of the blurred occupancy, along the wall's normal). A map of 10⁸ cells, a
campus of 500 m by 500 m, holds 1.4 GB; its fields are computed in bands of rows, so
that making it takes little more than twice that.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, UInt8
from scipy import ndimage

from fsmsm_jax import geometry
from fsmsm_jax.world.sizes import bucket

__all__ = ["OccupancyGrid"]

_OCCUPIED_PERCENT = 50
_BLUR = 1.5  # [cells]: wide enough that stair-steps of a slanted wall vanish
_BLUR_REACH = 7  # [cells] to which the blur and its gradient look: 4σ, and one more
_FAR = 255  # [cells]: the longest hop that a byte holds
_BAND = 1024  # rows of a map computed together


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
    size: Int[Array, "2"] | None = None
    """Rows and columns that are map, where `padded` added others; all, if None."""

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
        # By device_put: asarray copies, by a program for each shape. What was made here
        # changes no more; the caller's cells may, so they are copied.
        real = jax.dtypes.canonicalize_dtype(float)
        return cls(
            cells=jax.device_put(np.array(cells, np.int8)),
            resolution=jax.device_put(np.array(resolution, real)),
            origin=jax.device_put(np.array(origin, real)),
            clearance=jax.device_put(_clearance(stops)),
            distance=jax.device_put(_distance(occupied, resolution)),
            slope=jax.device_put(_slope(occupied)),
        )

    def padded(self) -> "OccupancyGrid":
        """The same map in larger arrays, so that maps of about its size share programs.

        Rows are added at the top and columns at the right, up to a `bucket` of each: an
        eighth more at most. They are no part of the map: rays leave it at its edge, and
        points beyond are off the map, as before.

        Example:
            >>> grid = OccupancyGrid.from_cells(np.zeros((300, 410), int), 0.05)
            >>> grid.padded().cells.shape
            (320, 416)
        """
        more = [(0, bucket(side) - side) for side in self.cells.shape]
        pad = lambda field, **how: jax.device_put(
            np.pad(np.asarray(field), [*more, (0, 0)][: field.ndim], **how)
        )
        return OccupancyGrid(
            cells=pad(self.cells, constant_values=-1),
            resolution=self.resolution,
            origin=self.origin,
            clearance=pad(self.clearance),
            distance=pad(self.distance, mode="edge"),
            slope=pad(self.slope, mode="edge"),
            size=jax.device_put(
                np.array([int(side) for side in self.extent], np.int32)
            ),
        )

    @property
    def extent(self) -> tuple[int | Int[Array, ""], int | Int[Array, ""]]:
        """Rows and columns of the map itself, without those that `padded` added."""
        height, width = self.cells.shape if self.size is None else self.size
        return height, width

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
        height, width = self.extent
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
        height, width = self.extent
        column, row = jnp.moveaxis(jnp.floor(self.to_cells(points)).astype(int), -1, 0)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return self.cells[row.clip(0, height - 1), column.clip(0, width - 1)], inside


def _bands(field, reach):
    """Bands of rows, each with up to `reach` more above and below that it depends on.

    Yields the rows of the band, the rows cut out around it, and the band within these.
    """
    height = len(field)
    for start in range(0, height, _BAND):
        stop = min(start + _BAND, height)
        low, high = max(start - reach, 0), min(stop + reach, height)
        yield slice(start, stop), field[low:high], slice(start - low, stop - low)


def _clearance(stops):
    """Chessboard distance to the nearest cell that stops a ray, and a ring of zeros."""
    stops = np.pad(stops, 1, constant_values=True)
    clearance = np.empty(stops.shape, np.uint8)
    for rows, around, band in _bands(stops, _FAR):
        hops = ndimage.distance_transform_cdt(~around, metric="chessboard")
        clearance[rows] = np.minimum(np.asarray(hops)[band], _FAR)
    return clearance


def _distance(occupied, resolution):
    """Distance [m] from each centre to the nearest occupied one."""
    distance = np.empty(occupied.shape, jax.dtypes.canonicalize_dtype(float))
    if not occupied.any():
        distance[:] = np.hypot(*occupied.shape) * resolution
        return distance
    # Whole numbers first: distances of all cells at once would be in float64.
    row, column = np.asarray(
        ndimage.distance_transform_edt(
            ~occupied, return_distances=False, return_indices=True
        )
    )
    across = np.arange(occupied.shape[1])
    for start in range(0, len(occupied), _BAND):
        rows = np.s_[start : start + _BAND]
        up = row[rows] - np.arange(len(occupied))[rows, None]
        distance[rows] = np.hypot(up, column[rows] - across) * resolution
    return distance


def _slope(occupied):
    """Gradient of the blurred occupancy along columns and rows."""
    slope = np.empty((*occupied.shape, 2), jax.dtypes.canonicalize_dtype(float))
    for rows, around, band in _bands(occupied, _BLUR_REACH):
        blurred = ndimage.gaussian_filter(around.astype(np.float32), _BLUR)
        for axis in (1, 0):
            along = ndimage.correlate1d(blurred, [-1, 0, 1], axis)
            slope[rows, :, 1 - axis] = along[band]
    return slope
