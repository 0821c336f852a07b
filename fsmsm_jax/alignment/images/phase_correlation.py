r"""Phase correlation in the plane: a shift between two pictures becomes a spike.

The symmetric phase-only matched filter (SPOMF; Chen, Defrise and Deconinck 1994) drops
the magnitudes of *both* spectra: $Q = e^{i(\phi_s - \phi_r)}$. If s is r shifted, that
is a pure wave, and its inverse DFT q a spike at the shift, of height 1; whatever the
two do not share spreads over the plane as noise of about 1 / √(pixels).

A pure spike is too sharp to be seen when the shift lies between pixels, and the finest
frequencies are mostly noise. So Q is weighed with a Gaussian low-pass whose mean is
1: a perfect match still has height 1, on a little Gaussian hill whose top can be found
between the pixels.

As in `alignment.spectrum`: shift k puts s[p + k] beside r[p].
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

__all__ = ["highest_peaks", "low_pass", "phase_spectrum", "signed_shift", "sub_pixel"]

_NOTHING = 1e-6  # of the strongest frequency: float32 knows no phases below
_FLOOR = 0.05  # of the top: what is lower beside it is noise, and may be negative


def phase_spectrum(image: Float[Array, "n m"]) -> Complex[Array, "n bins"]:
    """Half the DFT of an image with all magnitudes 1; 0 where there is nothing.

    Example:
        >>> F = phase_spectrum(jnp.eye(4))
        >>> bool(jnp.allclose(jnp.abs(F), (jnp.abs(F) > 0.5)))
        True
    """
    F = jnp.fft.rfft2(image)
    size = jnp.abs(F)
    present = size > _NOTHING * jnp.max(size)
    return jnp.where(present, F / jnp.where(present, size, 1.0), 0.0)


def low_pass(n: int, m: int, width: float) -> Float[np.ndarray, "n bins"]:
    """Weights on half a spectrum: a Gaussian of mean 1 over the whole spectrum.

    Args:
        n: rows of the image.
        m: columns of the image.
        width: standard deviation of the hill that a spike becomes [pixels].
    """
    f, g = np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(m)
    bell = lambda g: np.exp(-2 * (np.pi * width) ** 2 * (f**2 + g**2))
    return bell(g) / bell(np.fft.fftfreq(m)).mean()


def highest_peaks(
    q: Float[Array, "n m"], many: int, reach: float
) -> tuple[Int[Array, "many"], Int[Array, "many"]]:
    """Rows and columns of the highest local maxima, best first.

    Args:
        q: correlation over a plane that closes in both directions.
        many: how many.
        reach: largest shift between columns, to either side.
    """
    n, m = q.shape
    rows = jnp.max(jnp.stack([jnp.roll(q, k, 0) for k in (-1, 0, 1)]), axis=0)
    around = jnp.max(jnp.stack([jnp.roll(rows, k, 1) for k in (-1, 0, 1)]), axis=0)
    near = jnp.asarray(np.abs(np.fft.fftfreq(m) * m) <= reach)
    peaks = jnp.where((q >= around) & near[None], q, -jnp.inf)
    _, best = jax.lax.top_k(peaks.ravel(), many)
    return best // m, best % m


def sub_pixel(
    q: Float[Array, "n m"], i: Int[Array, ""], j: Int[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Where between the pixels the top of the hill about row i, column j lies.

    By a parabola each way through the logarithms, which is exact on Gaussian hills.
    """
    n, m = q.shape
    row = _vertex(q[i - 1, j], q[i, j], q[(i + 1) % n, j])
    column = _vertex(q[i, j - 1], q[i, j], q[i, (j + 1) % m])
    return i + row, j + column


def _vertex(left, middle, right):
    top = jnp.maximum(middle, _NOTHING)
    left, right = (jnp.log(jnp.clip(v / top, _FLOOR, 1.0)) for v in (left, right))
    curvature = left + right
    usable = curvature < -_NOTHING
    offset = 0.5 * (left - right) / jnp.where(usable, curvature, 1.0)
    return jnp.where(usable, jnp.clip(offset, -0.5, 0.5), 0.0)


def signed_shift(k: Float[Array, "*any"], size: int) -> Float[Array, "*any"]:
    """An index on a circle as a shift to either side, in [−size/2, size/2)."""
    return (k + size / 2) % size - size / 2
