"""A scan as a picture: the outline of what it saw, drawn on a square of pixels.

Registration of images (Fourier-Mellin) wants images. The end points of a panoramic
scan, joined in order, are a closed outline around the sensor. Seen from the sensor each
direction meets it once, so a place is inside if it is nearer than the outline in its
direction: two ranges, looked up and joined by their chord, tell. Which rays those are
is the same in every picture of one size, so that drawing costs one look at a short
table a pixel, where distances to all 720 edges would cost 720. Where inside and outside
meet, ink is spilt: along the walls, and along the rays that graze a corner.

The sensor is in the middle, x to the right, y up (row 0 is the top), and one scale
serves both axes: if the sensor turns clockwise, the picture turns counter-clockwise.
The thesis scales each picture to what it shows; here metres are metres, so that
pictures of one place have one scale (erratum E17 is about this step).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["outline_image"]

_NEAREST = 0.5  # [pixels]: an outline nearer than this would have no inside


def outline_image(
    ranges: Float[Array, "rays"], size: int, extent: float | Float[Array, ""]
) -> Float[Array, "size size"]:
    """Draw the outline that a panoramic scan's end points make, anti-aliased.

    Args:
        ranges: of a full circle [m], ray n at bearing −π + 2πn/rays (`panorama`).
        size: pixels along a side; static under `jit`.
        extent: side of the picture [m]; what lies farther than half of it from the
            sensor is cut off.

    Returns:
        Ink in [0, 1], on lines one to two pixels wide; pixel [row, column] is centred
        at x = column − (size − 1) / 2, y = (size − 1) / 2 − row, in pixels.

    Example:
        >>> diamond = jnp.full(4, 3.0)  # metres, two to a pixel
        >>> (outline_image(diamond, 5, 10.0)[2] > 0.5).tolist()
        [False, True, False, True, False]

    Note:
        Pure; `vmap` draws many. Not differentiable where there is no ink.
    """
    ray, u, v, distance = _corners(size, ranges.size)
    u, v, distance = (jnp.asarray(a, ranges.dtype) for a in (u, v, distance))
    nearness = 1 / jnp.maximum(ranges * (size / extent), _NEAREST)
    # Looked up in pairs: half as many looks, and looks are what drawing costs.
    before, after = jnp.moveaxis(
        jnp.stack([nearness, jnp.roll(nearness, -1)], axis=1)[ray], -1, 0
    )
    outline = 1 / (u * before + v * after)
    inside = jnp.clip(outline - distance + 0.5, 0, 1)
    # Roberts' cross: differences across each pixel, from the corners to its middle.
    falling = inside[1:, 1:] - inside[:-1, :-1]
    rising = inside[:-1, 1:] - inside[1:, :-1]
    return jnp.sqrt((falling**2 + rising**2) / 2)


def _corners(size: int, rays: int):
    """Of each corner of the pixels: the ray before it, two shares, its distance.

    On the chord between the end points of two rays Δ apart, at an angle α behind the
    first, 1/r = sin(Δ − α) / (r₀ sin Δ) + sin α / (r₁ sin Δ).
    """
    along = np.arange(size + 1) - size / 2
    x, y = np.meshgrid(along, -along)
    step = 2 * np.pi / rays
    turn = np.mod((np.arctan2(y, x) + np.pi) / step, rays)
    ray = np.floor(turn).astype(int)
    alpha = step * (turn - ray)
    share = np.sin(step - alpha) / np.sin(step), np.sin(alpha) / np.sin(step)
    return ray % rays, *share, np.hypot(x, y)
