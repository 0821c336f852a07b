r"""Orientation: which way a scan must be turned to look like another.

The two scans are taken to be from the same position; then a turn is a shift, and one
virtual scan serves all headings. The thesis finds the shift in three ways:

- `fourier_mellin`: the peak of the correlation of the ranges (`spectrum.py`).
- `procrustes`: the shift at which the end points fit best; the same peak by a detour.
- `first_principles`: the angle between the first harmonics. Hardly any work and no
  grid; but it is exact for whole-ray turns only, for one harmonic knows less than all.

The first two answer on the grid of rays, γ = 2π/N apart; `refined` interpolates the
peak, and `theseus.py` casts between the rays. From a wrong position the answer is wrong
too, in proportion (Remark VIII), so orientation alternates with `position.py`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.alignment.spectrum import (
    Spectrum,
    circular_correlation,
    first_harmonic,
    peak_offset,
    phase_correlation,
    squared_difference,
)

__all__ = [
    "METHODS",
    "Orientation",
    "first_principles",
    "fourier_mellin",
    "fourier_mellin_masked",
    "heading_costs",
    "percent_discrimination",
    "procrustes",
    "procrustes_trace",
    "turned",
]


class Orientation(NamedTuple):
    """What to add to the heading from which the virtual scan was cast."""

    correction: Float[Array, ""]
    """Angle to add to θ [rad], in [−π, π), as published: mostly a multiple of 2π/N."""
    refined: Float[Array, ""]
    """The same with the peak interpolated between rays [rad], in [−π, π)."""
    similarity: Float[Array, ""]
    """Percent discrimination at `correction`, to the nearest ray; 1 for equal scans."""


def turned(
    ranges: Float[Array, "rays"], angle: Float[Array, ""]
) -> Float[Array, "rays"]:
    """The full scan [m] as read after a turn by `angle` [rad], to the nearest ray.

    Example:
        >>> turned(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.asarray(1.5)).tolist()
        [2.0, 3.0, 4.0, 1.0]
    """
    shift = jnp.round(angle * ranges.size / (2 * jnp.pi)).astype(int)
    return jnp.roll(ranges, -shift)


def percent_discrimination(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    mask: Bool[Array, "rays"] | None = None,
) -> Float[Array, ""]:
    r"""How well two scans agree as they stand, $2 \sum r v / (\sum r^2 + \sum v^2)$.

    Counts the rays of the mask. At most 1, for equal scans; 0 without a ray.

    Example:
        >>> scan = jnp.array([1.0, 2.0, 3.0])
        >>> round(float(percent_discrimination(scan, 2 * scan)), 3)
        0.8

    Reference:
        Eq. 4.26 of the thesis's draft, without normalisation (erratum E2).
    """
    # Written as 1 − Σ(r − v)² / …, in which float32 keeps its digits near 1.
    difference = jnp.sum((ranges - virtual) ** 2, where=mask)
    energy = jnp.sum(ranges**2 + virtual**2, where=mask)
    similarity = 1 - difference / jnp.where(energy > 0, energy, 1.0)
    return jnp.where(energy > 0, similarity, 0.0)


def fourier_mellin(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    *,
    phase_only: bool = False,
) -> Orientation:
    r"""Heading correction from two full panoramic scans.

    With $q_k = \sum_n r_n v_{n+k}$ and $\xi = \arg\max_k q_k$, the new heading is
    $\hat\theta' = \hat\theta + \xi \gamma$.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        virtual: virtual scan [m], same rays, cast with the heading estimate θ̂.
        phase_only: take the peak of the phase correlation, as the thesis prints it and
            as its program does not (erratum E2). The similarity stays the same.

    Example:
        >>> real = jnp.array([1.0, 2.0, 3.0, 5.0])
        >>> turn = fourier_mellin(real, jnp.roll(real, 1))
        >>> round(float(turn.correction), 3), round(float(turn.similarity), 3)
        (1.571, 1.0)

    Reference:
        rc_fm, Algorithm XIII of the thesis; errata E1 (real scan conjugated) and E2.

    Note:
        Not differentiable (argmax). Every ray must hold a range; else use
        `fourier_mellin_masked`. Phases alone are right less often.
    """
    # Without the means q only loses a constant, and float32 keeps its digits.
    r, v = ranges - jnp.mean(ranges), virtual - jnp.mean(virtual)
    q = phase_correlation(r, v) if phase_only else circular_correlation(r, v)
    return _orientation(q, jnp.argmax(q), ranges, virtual)


def procrustes_trace(
    ranges: Float[Array, "rays"], virtual: Float[Array, "rays"]
) -> Float[Array, "rays"]:
    r"""How well the end points of two scans fit at every shift, turned at best [m²].

    With the end points as columns of $P_R$ and $P_V$, the latter's moved k to the left
    in $P_V^k$, and $M = P_R (P_V^k)^T$, the best rotation R reaches

    $$T_k = \max_R \mathrm{tr}(R P_V^k P_R^T)
          = \sqrt{(m_{11} + m_{22})^2 + (m_{12} - m_{21})^2} .$$

    For complex points p these are the parts of $\sum_n \bar p^R_n p^V_{n+k}$, one
    product of spectra. Rays n and n + k are kγ apart, which R turns back: so T is the
    `circular_correlation` of the ranges.

    Example:
        >>> real = jnp.array([1.0, 2.0, 3.0, 5.0])
        >>> procrustes_trace(real, jnp.roll(real, 1)).round().tolist()
        [28.0, 39.0, 28.0, 26.0]

    Reference:
        rc_uf_core (DBH), Algorithm XVI of the thesis, with errata E3 and E11.
    """
    bearings = 2 * np.pi * np.arange(ranges.size) / ranges.size - np.pi
    cosine = jnp.asarray(np.cos(bearings), ranges.dtype)
    sine = jnp.asarray(np.sin(bearings), ranges.dtype)
    points = lambda d: jnp.fft.fft(jax.lax.complex(d * cosine, d * sine))
    return jnp.abs(jnp.fft.ifft(jnp.conj(points(ranges)) * points(virtual)))


def procrustes(
    ranges: Float[Array, "rays"], virtual: Float[Array, "rays"]
) -> Orientation:
    r"""Heading correction from the end points of two full panoramic scans.

    $\hat\theta' = \hat\theta + \psi \gamma$ with $\psi = \arg\max_k T_k$. Arguments as
    for `fourier_mellin`.

    Example:
        >>> real = jnp.array([1.0, 2.0, 3.0, 5.0])
        >>> round(float(procrustes(real, jnp.roll(real, -1)).correction), 3)
        -1.571

    Reference:
        rc_uf, Algorithm XV of the thesis, with erratum E3 (ψ is the index itself).

    Note:
        Not differentiable (argmax). What `fourier_mellin` finds, for twice the work.
    """
    T = procrustes_trace(ranges, virtual)
    return _orientation(T, jnp.argmax(T), ranges, virtual)


def first_principles(
    ranges: Float[Array, "rays"], virtual: Float[Array, "rays"]
) -> Orientation:
    r"""Heading correction from the first harmonics of two full panoramic scans.

    $\hat\theta' = \hat\theta + \arg R_1 - \arg V_1$: how far the deep side has moved.
    Arguments as for `fourier_mellin`.

    Returns:
        A continuous correction, its own `refined`; 0 if a first harmonic is zero to
        rounding, as in the middle of a round room.

    Example:
        >>> real = jnp.array([1.0, 2.0, 3.0, 5.0])
        >>> round(float(first_principles(real, jnp.roll(real, 1)).correction), 3)
        1.571

    Reference:
        rc_x1, Algorithm XIV of the thesis; erratum E12 (exact for whole-ray turns).

    Note:
        Differentiable. In a symmetric room the harmonic is but noise: finite nonsense.
    """
    R1, V1 = first_harmonic(ranges), first_harmonic(virtual)
    rounding = lambda x: 4 * jnp.finfo(x.dtype).eps * jnp.sum(jnp.abs(x))
    lopsided = (jnp.abs(R1) > rounding(ranges)) & (jnp.abs(V1) > rounding(virtual))
    # The angle of zero has no derivative: take that of 1 instead.
    angle = jnp.angle(jnp.where(lopsided, R1 * jnp.conj(V1), 1.0))
    correction = geometry.wrap(angle)
    similarity = percent_discrimination(ranges, turned(virtual, correction))
    return Orientation(correction, correction, similarity)


METHODS: dict[str, Callable[..., Orientation]] = {
    "fourier_mellin": fourier_mellin,
    "procrustes": procrustes,
    "first_principles": first_principles,
}
"""The three methods of the thesis by name: `METHODS[name](ranges, virtual)`."""


def fourier_mellin_masked(
    ranges: Float[Array, "rays"],
    mask: Bool[Array, "rays"],
    virtual: Float[Array, "rays"],
    virtual_mask: Bool[Array, "rays"],
    min_overlap: float | Float[Array, ""] = 0.5,
) -> Orientation:
    """Heading correction for any field of view.

    Least mean squared difference over the rays that both scans know; with full masks
    the same as `fourier_mellin`. Correlation alone would reward long ranges: through
    180° it turns the scan towards the deepest side of the room.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        mask: its valid rays.
        virtual: virtual scan [m], same rays, cast with the heading estimate.
        virtual_mask: its valid rays.
        min_overlap: share of the real scan's valid rays that a heading must compare.

    Returns:
        The correction; 0 with similarity 0 if no heading compares enough rays.

    Example:
        >>> virtual = jnp.array([1.0, 2.0, 3.0, 5.0, 9.0, 4.0])
        >>> mask = jnp.array([False, True, True, True, False, False])
        >>> full = jnp.ones(6, bool)
        >>> turn = fourier_mellin_masked(jnp.roll(virtual, 2), mask, virtual, full)
        >>> round(float(turn.correction), 3)
        -2.094

    Note:
        Not differentiable (argmin).
    """
    R, V = Spectrum.of(ranges, mask), Spectrum.of(virtual, virtual_mask)
    costs = heading_costs(R, V, min_overlap)
    shift = jnp.argmin(costs)
    possible = mask & jnp.isfinite(costs[shift])
    return _orientation(costs, shift, ranges, virtual, (possible, virtual_mask))


def heading_costs(
    R: Spectrum, V: Spectrum, min_overlap: float | Float[Array, ""] = 0.5
) -> Float[Array, "rays"]:
    """Mean squared difference [m²] at every heading θ + 2πk/N, for ranking.

    Args:
        R: spectrum of the real scan.
        V: spectrum of the virtual scan.
        min_overlap: share of the real scan's valid rays that a heading must compare.

    Returns:
        One cost a heading; infinite where too few rays (or none) are compared.
    """
    D, overlap = squared_difference(R, V)
    enough = overlap >= jnp.maximum(min_overlap * R.weights[0].real, 1)
    return jnp.where(enough, D / jnp.where(enough, overlap, 1.0), jnp.inf)


def _orientation(
    q: Float[Array, "rays"],
    shift: Int[Array, ""],
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    masks: tuple[Bool[Array, "rays"], Bool[Array, "rays"]] | None = None,
) -> Orientation:
    """The answer for one shift: angles from the curve q, similarity from the rays."""
    gamma = 2 * jnp.pi / ranges.size
    both = None if masks is None else masks[0] & jnp.roll(masks[1], -shift)
    return Orientation(
        correction=geometry.wrap((gamma * shift).astype(ranges.dtype)),
        refined=geometry.wrap(gamma * (shift + peak_offset(q, shift))),
        similarity=percent_discrimination(ranges, jnp.roll(virtual, -shift), both),
    )
