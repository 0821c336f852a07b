"""How far from here was a scan taken, if the heading is known? Two answers.

**Centroids** (the thesis). The outline of what a scan saw is a polygon, its centroid a
point of the building. Two scans of one room see nearly the same polygon, so the
difference of the two centroids, each in its own scan's frame, is the way from one
sensor to the other. In a convex room that is exact at once, for both see all of it.
Near a doorway it is not even stable: a step shows or hides another room, and the
centroid moves farther than the sensor did.

**Pictures**. The same two outlines, drawn, are shifted pictures. Phase correlation asks
which shift puts most lines upon each other; walls that both show outvote what only one
shows, doorway or not. Its answer is good to a fraction of a pixel from the second step
on, and its peak tells how much the two have in common.
"""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.images.log_polar import apodised
from fsmsm_jax.alignment.images.phase_correlation import (
    low_pass,
    phase_spectrum,
    signed_shift,
    sub_pixel,
)

__all__ = ["outline_centroid", "picture_phases", "picture_shift"]

_FADE = 0.5  # share of a picture's sides that fades
_HILL = 1.0  # [pixels] width of a peak


def outline_centroid(
    ranges: Float[Array, "rays"], bearings: Float[Array, "rays"]
) -> Float[Array, "2"]:
    """Centroid of the polygon that a scan's end points make [m], in the sensor's frame.

    With C_R of a real scan and C_V of a virtual one from a hypothesis of the same
    heading, C_V − C_R is where the real sensor stands, in the hypothesis's frame.

    Reference:
        position_estimation, the thesis's chapter 5.
    """
    directions = jnp.stack([jnp.cos(bearings), jnp.sin(bearings)], axis=1)
    return geometry.polygon_centroid(ranges[:, None] * directions)


def picture_phases(
    picture: Float[Array, "size size"],
) -> Complex[Array, "size bins"]:
    """What `picture_shift` compares of a picture; made once for many comparisons."""
    return phase_spectrum(apodised(picture, _FADE))


def picture_shift(
    r: Complex[Array, "size bins"], s: Complex[Array, "size bins"]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """How things in one picture are shifted in another, by phase correlation.

    Args:
        r: `picture_phases` of the first picture.
        s: those of the second.

    Returns:
        The shift (x to the right, y up) from r to s [pixels]. If they are pictures from
        two sensors of one heading, it is where the sensor of r stands, seen from that
        of s. And the height of the peak: 1 if the pictures are equal but for it.

    Example:
        >>> picture = jnp.zeros((64, 64)).at[20:30, 25:40].set(1.0)
        >>> moved = jnp.roll(picture, (-3, 5), (0, 1))  # 3 rows up, 5 columns right
        >>> shift, peak = picture_shift(picture_phases(picture), picture_phases(moved))
        >>> shift.round(1).tolist()
        [5.0, 3.0]
    """
    size = r.shape[0]
    weights = jnp.asarray(low_pass(size, size, _HILL), r.real.dtype)
    q = jnp.fft.irfft2(jnp.conj(r) * s * weights, (size, size))
    i, j = jnp.divmod(jnp.argmax(q), size)
    row, column = sub_pixel(q, i, j)
    shift = jnp.stack([signed_shift(column, size), -signed_shift(row, size)])
    return shift, q[i, j]
