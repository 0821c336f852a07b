r"""The last hundredths of a pixel: least squares on the pixels themselves.

Phase correlation finds the similarity to a tenth of a degree and of a pixel. From there
Gauss-Newton on the grey values goes on: with the similarity written as a matrix,
$T(p) = A p + t$, $A = \begin{pmatrix} a & -b \\ b & a \end{pmatrix}$, the four numbers
a, b, t, and a gain g and an offset h for another exposure, minimise

$$\sum_p w_p \left( s(T(p)) - g\, r(p) - h \right)^2$$

over the pixels that both images show. The gradient comes from the warped image at no
cost. Pixels that fit badly (a black border, a passer-by) lose their vote by
Geman-McClure's weights, whose width follows the others' residuals. Both images are
blurred, first more, then less: what is blurred can be followed from farther away.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fsmsm_jax.alignment.images.log_polar import fading
from fsmsm_jax.alignment.images.similarity_warp import pixel_places, similarity_warp

__all__ = ["fit_similarity"]

_BLURS = (2.5, 1.0)  # [pixels] standard deviations, one round each
_WIDE = 3.0  # of the weights, in mean absolute residuals


def fit_similarity(
    r: Float[Array, "n m"],
    s: Float[Array, "n m"],
    rotation: Float[Array, ""],
    scale: Float[Array, ""],
    shift: Float[Array, "2"],
    steps: int,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, "2"]]:
    """A similarity (see `similarity_warp`) with which s looks like r, improved.

    Args:
        r: reference image, of contrast about 1.
        s: the other image.
        rotation: first estimate [rad], within some degrees.
        scale: first estimate, within some per cent.
        shift: first estimate [pixels], (x to the right, y up), within a few.
        steps: of Gauss-Newton, for each of the two rounds.

    Returns:
        Rotation, scale and shift; not checked for being better.
    """
    place = jnp.stack(
        [scale * jnp.cos(rotation), scale * jnp.sin(rotation), shift[0], shift[1]]
    )
    coarse_to_fine = [
        jnp.stack([_blurred(image, width) for width in _BLURS]) for image in (r, s)
    ]
    go = lambda place, both: (_round(both[0], both[1], place, steps), None)
    place = jax.lax.scan(go, place, tuple(coarse_to_fine))[0]
    a, b = place[0], place[1]
    return jnp.arctan2(b, a), jnp.hypot(a, b), place[2:]


def _round(r, s, place, steps):
    n, m = r.shape
    x, y = (jnp.asarray(v.ravel(), r.dtype) for v in pixel_places(n, m))
    window = jnp.asarray(fading(n, m, 1.0).ravel(), r.dtype)
    r = r.ravel()
    tiny = 1e-3 * jnp.std(r) + jnp.finfo(r.dtype).tiny

    def step(state, _):
        place, vote = state
        a, b = place[0], place[1]
        w, inside = similarity_warp(s, jnp.arctan2(b, a), jnp.hypot(a, b), place[2:])
        down, right = (v.ravel() for v in jnp.gradient(w))
        # The gradient of w = s∘T is Aᵀ times that of s at T(p), which is wanted here.
        size = jnp.maximum(a**2 + b**2, 1e-6)
        s_x, s_y = (a * right + b * down) / size, (b * right - a * down) / size
        J = jnp.stack(
            [s_x * x + s_y * y, s_y * x - s_x * y, s_x, s_y, -r, -jnp.ones_like(r)]
        )
        vote = vote * window * inside.ravel()
        delta = _solve((J * vote[None]) @ J.T, (J * vote[None]) @ w.ravel())
        e = w.ravel() + delta @ J
        spread = jnp.sum(vote * jnp.abs(e)) / jnp.maximum(jnp.sum(vote), 1e-6)
        vote = 1 / (1 + (e / (_WIDE * spread + tiny)) ** 2) ** 2
        return (place + delta[:4], vote), None

    return jax.lax.scan(step, (place, jnp.ones_like(r)), length=steps)[0][0]


def _solve(G, g):
    """Gauss-Newton's step; of numbers so unlike in size, in their own units."""
    unit = jnp.sqrt(jnp.diag(G)) + 1e-6
    G = G / (unit[:, None] * unit[None]) + 1e-6 * jnp.eye(g.size, dtype=g.dtype)
    return -jnp.linalg.solve(G, g / unit) / unit


def _blurred(image, width):
    """By a Gaussian; at the border, by the part of it that is inside."""
    down, right = (
        jnp.asarray(_blurring(size, width), image.dtype) for size in image.shape
    )
    return down @ image @ right.T


def _blurring(size, width):
    """The blur of a column as a matrix: on small images faster than two FFTs."""
    apart = np.arange(size)[:, None] - np.arange(size)
    bell = np.exp(-0.5 * (apart / width) ** 2)
    return bell / bell.sum(axis=1, keepdims=True)
