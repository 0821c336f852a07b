"""Symmetric 2 × 2 matrices by their three numbers, for many at once.

A landmark's covariance is a, b, d in [[a, b], [b, d]]. Filters hold hundreds of
landmarks for each of hundreds of particles; as three arrays all of them are added,
inverted and turned by element-wise arithmetic, which compilers do well, where
products of tiny matrices they do badly. Vectors are pairs of arrays likewise.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["Pair", "Sym2"]

Pair = tuple[Float[Array, "*shape"], Float[Array, "*shape"]]


class Sym2(NamedTuple):
    """Symmetric matrices [[xx, xy], [xy, yy]]."""

    xx: Float[Array, "*shape"]
    xy: Float[Array, "*shape"]
    yy: Float[Array, "*shape"]

    def plus(self, other: "Sym2") -> "Sym2":
        """The sum."""
        return Sym2(self.xx + other.xx, self.xy + other.xy, self.yy + other.yy)

    def minus(self, other: "Sym2") -> "Sym2":
        """The difference."""
        return Sym2(self.xx - other.xx, self.xy - other.xy, self.yy - other.yy)

    def times(self, vector: Pair) -> Pair:
        """Matrix times vector."""
        x, y = vector
        return self.xx * x + self.xy * y, self.xy * x + self.yy * y

    def form(self, one: Pair, other: Pair) -> Float[Array, "*shape"]:
        """The bilinear form, one' A other."""
        x, y = self.times(other)
        return one[0] * x + one[1] * y

    def within(self, outer: "Sym2") -> "Sym2":
        """The product outer · self · outer, symmetric again."""
        left = self.times((outer.xx, outer.xy))
        right = self.times((outer.xy, outer.yy))
        return Sym2(
            outer.xx * left[0] + outer.xy * left[1],
            outer.xy * left[0] + outer.yy * left[1],
            outer.xy * right[0] + outer.yy * right[1],
        )

    def determinant(self) -> Float[Array, "*shape"]:
        """Above zero: as small as rounding lets one tell, for singular covariances."""
        square = self.xx * self.yy
        info = jnp.finfo(square.dtype)
        least = jnp.maximum(info.eps * square, info.tiny)
        return jnp.maximum(square - self.xy * self.xy, least)

    def inverse(self) -> "Sym2":
        """Of positive definite ones."""
        scale = 1 / self.determinant()
        return Sym2(scale * self.yy, -scale * self.xy, scale * self.xx)

    @classmethod
    def along(cls, direction: Pair, length: Array, across: Array) -> "Sym2":
        """Variances along a unit vector and across it."""
        c, s = direction
        excess = length - across
        return cls(across + excess * c * c, excess * c * s, across + excess * s * s)
