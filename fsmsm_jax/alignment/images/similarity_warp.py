r"""Similarities of the image plane: seeing one image as another one shows it.

A similarity turns by ξ, magnifies by σ and shifts by t, about the image's centre:

$$T(p) = \sigma R(\xi)\, p + t, \qquad p = (x, y)\ \text{from the centre, in pixels.}$$

All of it reads as on the screen and as on a map: x to the right, **y up**, angles
counter-clockwise, though an array's rows grow downward. The centre is the middle of the
array, between the pixels of even sides. So `image[i, j]` is the value at
x = j − (m − 1)/2, y = (n − 1)/2 − i.

Images are pulled, not pushed: the warped image at p is the given one at T(p), by linear
interpolation between four pixels; a weight tells which of it lay outside.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["bilinear", "pixel_places", "similarity_warp"]


def pixel_places(
    n: int, m: int
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Where the pixels of an n × m image lie: x to the right, y up, from the centre.

    Example:
        >>> x, y = pixel_places(2, 3)
        >>> x[0].tolist(), y[:, 0].tolist()
        ([-1.0, 0.0, 1.0], [0.5, -0.5])
    """
    x, y = np.arange(m) - (m - 1) / 2, (n - 1) / 2 - np.arange(n)
    across, up = np.meshgrid(x, y)
    return across, up


def bilinear(
    image: Float[Array, "n m"],
    row: Float[Array, "*places"],
    column: Float[Array, "*places"],
) -> Float[Array, "*places"]:
    """The image between its pixels; beyond its edge, the edge's values.

    Example:
        >>> image = jnp.array([[0.0, 1.0], [2.0, 3.0]])
        >>> float(bilinear(image, jnp.array(0.5), jnp.array(0.25)))
        1.25
    """
    n, m = image.shape
    row, column = jnp.clip(row, 0, n - 1), jnp.clip(column, 0, m - 1)
    i = jnp.clip(jnp.floor(row).astype(int), 0, n - 2)
    j = jnp.clip(jnp.floor(column).astype(int), 0, m - 2)
    a, b = row - i, column - j
    flat, k = image.ravel(), i * m + j
    above = (1 - b) * flat[k] + b * flat[k + 1]
    below = (1 - b) * flat[k + m] + b * flat[k + m + 1]
    return (1 - a) * above + a * below


def similarity_warp(
    image: Float[Array, "n m"],
    rotation: Float[Array, ""],
    scale: Float[Array, ""],
    shift: Float[Array, "2"],
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    r"""An image pulled back through a similarity: $w(p) = \mathrm{image}(T(p))$.

    With the answer of `fmi_spomf(r, s)`, `similarity_warp(s, ...)` looks like r.

    Args:
        image: the one to be looked at.
        rotation: ξ [rad], counter-clockwise on the screen.
        scale: σ, how many pixels of `image` one pixel of the result is wide.
        shift: t [pixels], (x to the right, y up).

    Returns:
        The image, with the nearest edge's values where T(p) is outside, and a weight:
        1 inside, 0 outside.

    Example:
        >>> image = jnp.array([[1.0, 2.0], [3.0, 4.0]])
        >>> turned, _ = similarity_warp(
        ...     image, jnp.array(jnp.pi / 2), jnp.array(1.0), jnp.zeros(2)
        ... )
        >>> turned.round().astype(int).tolist()
        [[3, 1], [4, 2]]
    """
    n, m = image.shape
    x, y = (jnp.asarray(v, image.dtype) for v in pixel_places(n, m))
    a, b = scale * jnp.cos(rotation), scale * jnp.sin(rotation)
    row = (n - 1) / 2 - (b * x + a * y + shift[1])
    column = a * x - b * y + shift[0] + (m - 1) / 2
    inside = (row >= 0) & (row <= n - 1) & (column >= 0) & (column <= m - 1)
    return bilinear(image, row, column), inside.astype(image.dtype)
