r"""Scans as periodic signals: the DFT tools that alignment stands on.

A panoramic scan is one period: ray n of N looks along −π + 2πn/N, so turning the
sensor by k rays shifts the signal by k, and nothing else happens to it as long as the
sensor stays where it is. One product of spectra therefore compares two scans at all N
headings at once, in O(N log N).

For a full scan the plain correlation says it all, since $\sum (r - v)^2 = \sum r^2 +
\sum v^2 - 2q$. With holes in the scans (a 180° sensor, invalid rays) the two energies
change with the heading as well; `squared_difference` then counts exactly the rays that
both scans know, from three spectra a scan. Those of a map's scans are made once
(`Spectrum.of`) and compared with every real scan that comes.

All shifts read alike: shift k puts v[n + k] beside r[n] (erratum E1: the real scan's
spectrum is the conjugated one).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

__all__ = [
    "Spectrum",
    "circular_correlation",
    "first_harmonic",
    "masked_squared_difference",
    "peak_offset",
    "phase_correlation",
    "squared_difference",
]


def first_harmonic(x: Float[Array, "rays"]) -> Complex[Array, ""]:
    r"""First DFT coefficient, $X_1 = \sum_n x_n e^{-2\pi i n / N}$.

    Of a scan it holds where, and how far, the surroundings lie to one side.

    Example:
        >>> wave = jnp.cos(2 * jnp.pi * jnp.arange(8) / 8)
        >>> complex(first_harmonic(wave).round(3))
        (4+0j)

    Reference:
        diff_dft, Algorithm XX of the thesis.
    """
    turn = 2 * np.pi * np.arange(x.size) / x.size
    cosine, sine = (
        jnp.asarray(np.cos(turn), x.dtype),
        jnp.asarray(np.sin(turn), x.dtype),
    )
    return jax.lax.complex(x @ cosine, -(x @ sine))


def circular_correlation(
    r: Float[Array, "rays"], v: Float[Array, "rays"]
) -> Float[Array, "rays"]:
    r"""Correlation at every shift, $q_k = \sum_n r_n v_{n+k}$ (indices modulo N).

    Computed as $q = F^{-1}\{\overline{F r} \cdot F v\}$, without the division by
    magnitudes that the thesis prints and its program leaves out (errata E1, E2).

    Example:
        >>> r = jnp.array([1.0, 0.0, 0.0, 0.0])
        >>> circular_correlation(r, jnp.roll(r, 3)).round(3).tolist()
        [0.0, 0.0, 0.0, 1.0]

    Note:
        Means far above the variation drown it in rounding; take them off before.
    """
    return jnp.fft.irfft(jnp.conj(jnp.fft.rfft(r)) * jnp.fft.rfft(v), r.size)


def phase_correlation(
    r: Float[Array, "rays"], v: Float[Array, "rays"]
) -> Float[Array, "rays"]:
    """Correlation of the phases alone: the thesis's formula as printed (erratum E2).

    Two scans that differ by a shift give 1 at that shift and 0 elsewhere. Sharper than
    `circular_correlation` at the true position, but it weighs the noisy fine harmonics
    like the coarse ones and fails earlier away from it. Frequencies that one of the
    scans lacks count as zero.

    Example:
        >>> r = jnp.array([3.0, 1.0, 2.0, 5.0])
        >>> phase_correlation(r, jnp.roll(r, 1)).round(3).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    product = jnp.conj(jnp.fft.rfft(r)) * jnp.fft.rfft(v)
    magnitude = jnp.abs(product)
    present = magnitude > jnp.finfo(r.dtype).eps * jnp.max(magnitude)
    phases = jnp.where(present, product / jnp.where(present, magnitude, 1.0), 0.0)
    return jnp.fft.irfft(phases, r.size)


class Spectrum(eqx.Module):
    """A masked scan as `squared_difference` wants it: the DFTs of m, m z and m z²."""

    weights: Complex[Array, "bins"]
    """DFT of the mask m, half of it: `bins` = rays // 2 + 1."""
    values: Complex[Array, "bins"]
    """DFT of m (z − offset) [m]."""
    squares: Complex[Array, "bins"]
    """DFT of m (z − offset)² [m²]."""
    offset: Float[Array, ""]
    """Mean of z over the mask [m], taken off for the sake of float32."""
    rays: int = eqx.field(static=True)
    """Length N of the scan, which a half spectrum forgets."""

    @classmethod
    def of(cls, z: Float[Array, "rays"], mask: Bool[Array, "rays"]) -> "Spectrum":
        """The spectra of a scan with holes.

        Args:
            z: one value a ray, usually ranges [m] or their logarithms; ignored, but
                not NaN, where the mask is off.
            mask: which rays to believe.

        Example:
            >>> V = Spectrum.of(jnp.array([1.0, 2.0, 3.0, 9.0]), jnp.arange(4) < 3)
            >>> float(V.offset), V.rays
            (2.0, 4)

        Note:
            `vmap` over a map's scans makes the database; it is three times as large
            as the ranges.
        """
        m = mask.astype(z.dtype)
        offset = jnp.sum(m * z) / jnp.maximum(jnp.sum(m), 1)
        z = m * (z - offset)
        weights, values, squares = jnp.fft.rfft(jnp.stack([m, z, z**2]))
        return cls(weights, values, squares, offset, z.size)


def squared_difference(
    R: Spectrum, V: Spectrum
) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    r"""Masked squared difference of two scans at every shift, from their spectra.

    With masks m and μ, and $\star$ the circular correlation,

    $$D_k = \sum_n m_n \mu_{n+k} (r_n - v_{n+k})^2
          = (m r^2 \star \mu + m \star \mu v^2 - 2\, m r \star \mu v)_k .$$

    Args:
        R: spectrum of the real scan.
        V: spectrum of the virtual scan, of as many rays.

    Returns:
        The sum D [m²] and the overlap $(m \star \mu)_k$, the number of rays compared.

    Raises:
        ValueError: the scans have different numbers of rays.

    Note:
        Two inverse FFTs; `vmap(squared_difference, (None, 0))` ranks a database.
        Measured error in float32: below 1e-6 of Σ m (r − c)² + Σ μ (v − c)², with c
        the mean of v; D is clipped at 0 and the overlap is exact.
    """
    if R.rays != V.rays:
        raise ValueError(f"cannot compare scans of {R.rays} and of {V.rays} rays")
    # Bring r to the offset of v: (z + s)² = z² + 2 s z + s², linear in the spectra.
    s = R.offset - V.offset
    values = R.values + s * R.weights
    squares = R.squares + 2 * s * R.values + s**2 * R.weights
    D = (
        jnp.conj(squares) * V.weights
        + jnp.conj(R.weights) * V.squares
        - 2 * jnp.conj(values) * V.values
    )
    overlap = jnp.conj(R.weights) * V.weights
    D, overlap = jnp.fft.irfft(jnp.stack([D, overlap]), R.rays)
    return jnp.maximum(D, 0.0), jnp.round(overlap)


def masked_squared_difference(
    r: Float[Array, "rays"],
    mask_r: Bool[Array, "rays"],
    v: Float[Array, "rays"],
    mask_v: Bool[Array, "rays"],
) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """`squared_difference` of two scans used only once.

    Example:
        >>> r, v = jnp.array([1.0, 2.0, 0.0, 0.0]), jnp.array([7.0, 5.0, 1.0, 2.5])
        >>> known, full = jnp.array([True, True, False, False]), jnp.ones(4, bool)
        >>> difference, overlap = masked_squared_difference(r, known, v, full)
        >>> difference.round(2).tolist(), overlap.tolist()
        ([45.0, 17.0, 0.25, 27.25], [2.0, 2.0, 2.0, 2.0])
    """
    return squared_difference(Spectrum.of(r, mask_r), Spectrum.of(v, mask_v))


def peak_offset(q: Float[Array, "rays"], k: Int[Array, ""]) -> Float[Array, ""]:
    """Where between the samples the extremum at k really lies, in samples.

    The vertex of the parabola through q at k − 1, k, k + 1 (circular), for maxima and
    minima alike, in [−½, ½]; 0 where the three lie on a line or are not finite.

    Example:
        >>> q = -((jnp.arange(8.0) - 3.25) ** 2)
        >>> float(peak_offset(q, jnp.argmax(q)))
        0.25
    """
    left, middle, right = q[k - 1], q[k], q[(k + 1) % q.size]
    curvature = left - 2 * middle + right
    usable = jnp.isfinite(curvature) & (curvature != 0)
    offset = 0.5 * (left - right) / jnp.where(usable, curvature, 1.0)
    return jnp.where(usable, jnp.clip(offset, -0.5, 0.5), 0.0)
