r"""Fourier-Mellin in the plane: turning and magnifying an image shifts its spectrum.

Where the things in an image are is in the phases of its spectrum; how they are turned,
and how large they are, is in the magnitudes. If s shows r turned by ξ and σ times as
large, wherever it went,

$$|S|(\theta, \rho) \propto |R|(\theta - \xi, \sigma \rho),$$

so over (θ, log ρ) one picture is the other, shifted by (ξ, −log σ): eq. 1.7 of the
thesis's draft. The magnitudes of a real image repeat after half a turn; hence θ covers
only π, without a seam, and ξ comes out with an ambiguity of π.

Four things make the picture clean. The image is *apodised*, faded to nothing towards
its border, for the DFT sees opposite borders as neighbours and draws a bright cross for
the jump between them. It is padded to twice its size, for a spectrum fine enough to be
interpolated. A *high-pass* keeps the spectrum's middle, which knows least of angles,
from outshining the rest. And the picture fades at its lowest and highest ρ, as log ρ,
unlike θ, has two ends.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fsmsm_jax.alignment.images.similarity_warp import bilinear

__all__ = ["apodised", "fading", "log_polar_spectrum"]

_TAPER = 0.5  # share of the radii that fade


def fading(n: int, m: int, taper: float) -> Float[np.ndarray, "n m"]:
    """A window over n × m pixels: 1 in the middle, 0 at the border, cosines between.

    Args:
        n: rows.
        m: columns.
        taper: share of each side that fades, half of it at either end; 1 is Hann's
            window, less is Tukey's.

    Example:
        >>> fading(4, 4, 0.5).round(2)[1].tolist()
        [0.5, 1.0, 1.0, 0.5]
    """
    return np.outer(_fading(n, taper), _fading(m, taper))


def _fading(size: int, taper: float) -> Float[np.ndarray, "size"]:
    place = np.arange(size) + 0.5
    to_border = np.minimum(place, size - place) / size
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(2 * to_border / taper, 1.0))


def apodised(image: Float[Array, "n m"], taper: float) -> Float[Array, "n m"]:
    """The image less its mean, faded to nothing at the border (see `fading`).

    The mean is that under the window, so that the sum of the result is nought.

    Example:
        >>> bool(jnp.allclose(apodised(jnp.full((4, 4), 7.0), 1.0), 0.0))
        True
    """
    n, m = image.shape
    window = fading(n, m, taper)
    share = jnp.asarray(window / window.sum(), image.dtype)
    return jnp.asarray(window, image.dtype) * (image - jnp.sum(share * image))


def log_polar_spectrum(
    image: Float[Array, "n m"],
    angles: int,
    radii: int,
    lowest: float,
    highest: float,
) -> Float[Array, "angles radii"]:
    r"""Magnitudes of an image's spectrum over (θ, log ρ).

    Args:
        image: any real values.
        angles: how many θ, equally spaced over [−π/2, π/2), counter-clockwise.
        radii: how many ρ, in geometric progression.
        lowest: first ρ [cycles a pixel].
        highest: last ρ [cycles a pixel], below ½.

    Returns:
        $\sqrt\rho\,|F|$, less its mean, faded at both ends of ρ.

    Note:
        The high-pass √ρ is gentler than the (1 − X)(2 − X) of Reddy and Chatterji
        (1996), which behaves as ρ² and lifts noise above most images: with noise as
        large as the contrast, the right peak was highest in 58 % of pairs with theirs
        and in 86 % with this one; without noise both find all (152 pairs).
    """
    n, m = image.shape
    size = 2 * n, 2 * m
    magnitude = jnp.abs(jnp.fft.rfft2(apodised(image, 1.0), size))
    theta = -np.pi / 2 + np.pi * np.arange(angles) / angles
    rho = np.geomspace(lowest, highest, radii)
    u, v = rho * np.cos(theta)[:, None], rho * np.sin(theta)[:, None]
    # v is upward and rows go down; the first row, again at the end, closes the circle.
    closed = jnp.concatenate([magnitude, magnitude[:1]])
    row, column = np.mod(-v * size[0], size[0]), u * size[1]
    picture = bilinear(
        closed, jnp.asarray(row, image.dtype), jnp.asarray(column, image.dtype)
    )
    picture = picture * jnp.asarray(np.sqrt(rho), image.dtype)[None]
    ends = jnp.asarray(_fading(radii, _TAPER), image.dtype)
    return (picture - jnp.mean(picture)) * ends[None]
