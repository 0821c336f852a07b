"""Polygon maps: worlds of straight walls, in which ray casting is exact.

The thesis's environments are closed outlines of points. A `PolygonMap` keeps
them as segments, start to end, so that several outlines (a room and the pillars
in it) are one array and a ray meets each segment by two lines of algebra.

What a scan has seen is such a world too (`sensing.seen_space`), but it ends in places
where nothing stands: at the border of the field of view, or beside an object that
hides what is behind it. There its outline is a veil, not a wall: where a ray meets it
first, nothing is known.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

__all__ = ["PolygonMap"]


class PolygonMap(eqx.Module):
    """A world of straight walls; build one with `PolygonMap.from_outlines`."""

    start: Float[Array, "segments 2"]
    """First end of each wall, map frame [m]."""
    end: Float[Array, "segments 2"]
    """Second end of each wall, map frame [m]."""
    solid: Bool[Array, "segments"] | None = None
    """Which segments are walls and not veils; all, if None. A ray that meets a veil
    first, coming from its left, reads `range_max`, as one that meets nothing. From its
    right it passes: in a counter-clockwise outline, into what was seen."""

    @classmethod
    def from_outlines(cls, *outlines: Sequence | np.ndarray | Array) -> "PolygonMap":
        """Walls along closed outlines, each an ordered (vertices, 2) array [m].

        The last vertex is joined to the first; do not repeat it.

        Raises:
            ValueError: no outline, fewer than three vertices, a wrong shape, or
                a coordinate that is not finite.

        Example:
            >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
            >>> room.start.shape
            (4, 2)
        """
        if not outlines:
            raise ValueError(
                "a PolygonMap needs at least one outline of (vertices, 2) points"
            )
        starts, ends = [], []
        for number, outline in enumerate(outlines):
            vertices = np.asarray(outline, float)
            if vertices.ndim != 2 or vertices.shape[1] != 2 or len(vertices) < 3:
                raise ValueError(
                    f"outline {number} must be (vertices ≥ 3, 2) points, "
                    f"got {vertices.shape}"
                )
            if not np.isfinite(vertices).all():
                raise ValueError(
                    f"outline {number} holds a coordinate that is not finite"
                )
            starts.append(vertices)
            ends.append(np.roll(vertices, -1, axis=0))
        return cls(
            start=jnp.asarray(np.concatenate(starts), float),
            end=jnp.asarray(np.concatenate(ends), float),
        )

    def distance_at(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
        """Distance [m] from map-frame points to the nearest wall; differentiable.

        Veils are none; without any wall it is infinite.
        """
        x, y = points[..., 0, None], points[..., 1, None]  # points down, walls across
        each = (1,) * (points.ndim - 1) + (-1,)
        (ax, ay), (bx, by) = (
            self.start.T.reshape(2, *each),
            self.end.T.reshape(2, *each),
        )
        wx, wy = bx - ax, by - ay
        length2 = jnp.maximum(wx**2 + wy**2, jnp.finfo(wx.dtype).tiny)
        along = jnp.clip(((x - ax) * wx + (y - ay) * wy) / length2, 0, 1)
        gap2 = (x - ax - along * wx) ** 2 + (y - ay - along * wy) ** 2
        if self.solid is not None:
            gap2 = jnp.where(self.solid.reshape(each), gap2, jnp.inf)
        gap2 = gap2.min(axis=-1)
        # The square root has no slope at a wall; a millionth of a metre gives it one.
        return jnp.sqrt(gap2 + 1e-12)

    def contains(self, points: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
        """Whether map-frame points [m] lie inside, by the even-odd rule."""
        x, y = points[..., 0, None], points[..., 1, None]
        each = (1,) * (points.ndim - 1) + (-1,)
        (x0, y0), (x1, y1) = (
            self.start.T.reshape(2, *each),
            self.end.T.reshape(2, *each),
        )
        straddles = (y0 <= y) != (y1 <= y)
        rise = jnp.where(straddles, y1 - y0, 1.0)
        crossing = x0 + (y - y0) * (x1 - x0) / rise
        return jnp.sum(straddles & (x < crossing), axis=-1) % 2 == 1

    def unknown_at(self, points: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
        """Nowhere: a polygon map knows all of its world."""
        return jnp.zeros(points.shape[:-1], bool)
