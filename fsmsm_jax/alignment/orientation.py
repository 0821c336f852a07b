r"""Orientation: which way a scan must be turned to look like another.

The two scans are taken to be from the same position; then a turn is a shift, and the
best shift is the peak of their correlation (`spectrum.py`). This is Fourier-Mellin
registration in one dimension, and one virtual scan serves all headings. The answer
lies on the grid of rays, γ = 2π/N apart; `refined` interpolates between them.

From a wrong position the answer is wrong too, in proportion (Remark VIII: orientation
is exact only if position is), so it alternates with `position.py`.

Similarity is the thesis's percent discrimination, $2 q_{max} / (\sum r^2 + \sum v^2)$,
which equals $1 - \sum (r - v)^2 / (\sum r^2 + \sum v^2)$ at the best shift: 1 for equal
scans. The second form is the one that masks carry over to.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.alignment.spectrum import (
    Spectrum,
    circular_correlation,
    peak_offset,
    squared_difference,
)

__all__ = ["Orientation", "fourier_mellin", "fourier_mellin_masked", "heading_costs"]


class Orientation(NamedTuple):
    """What to add to the heading from which the virtual scan was cast."""

    correction: Float[Array, ""]
    """Angle to add to θ [rad], in [−π, π), a multiple of 2π/N: as published."""
    refined: Float[Array, ""]
    """The same with the peak interpolated between rays [rad], in [−π, π)."""
    similarity: Float[Array, ""]
    """Percent discrimination in [0, 1] at `correction`; 1 when the scans agree."""


def fourier_mellin(
    ranges: Float[Array, "rays"], virtual: Float[Array, "rays"]
) -> Orientation:
    r"""Heading correction from two full panoramic scans.

    With $q_k = \sum_n r_n v_{n+k}$ and $\xi = \arg\max_k q_k$, the new heading is
    $\hat\theta' = \hat\theta + \xi \gamma$.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        virtual: virtual scan [m], same rays, cast with the heading estimate θ̂.

    Example:
        >>> real = jnp.array([1.0, 2.0, 3.0, 5.0])
        >>> turn = fourier_mellin(real, jnp.roll(real, 1))
        >>> round(float(turn.correction), 3), round(float(turn.similarity), 3)
        (1.571, 1.0)

    Reference:
        rc_fm, Algorithm XIII of the thesis, with errata E1 and E2 (correlation without
        normalisation, the real scan conjugated).

    Note:
        Not differentiable (argmax). Every ray must hold a range; else use
        `fourier_mellin_masked`.
    """
    # Without the means q only loses a constant, and float32 keeps its digits.
    r, v = ranges - jnp.mean(ranges), virtual - jnp.mean(virtual)
    q = circular_correlation(r, v)
    shift = jnp.argmax(q)
    everywhere = jnp.ones(ranges.shape, bool)
    return _orientation(q, shift, ranges, everywhere, virtual, everywhere)


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
    return _orientation(costs, shift, ranges, possible, virtual, virtual_mask)


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
    mask: Bool[Array, "rays"],
    virtual: Float[Array, "rays"],
    virtual_mask: Bool[Array, "rays"],
) -> Orientation:
    """The answer for one shift: angles from the curve q, similarity from the rays."""
    gamma = 2 * jnp.pi / ranges.size
    both = mask & jnp.roll(virtual_mask, -shift)
    v = jnp.roll(virtual, -shift)
    difference = jnp.sum((ranges - v) ** 2, where=both)
    energy = jnp.sum(ranges**2 + v**2, where=both)
    similarity = 1 - difference / jnp.where(energy > 0, energy, 1.0)
    refined = shift + peak_offset(q, shift)
    return Orientation(
        correction=geometry.wrap((gamma * shift).astype(ranges.dtype)),
        refined=geometry.wrap(gamma * refined),
        similarity=jnp.where(energy > 0, similarity, 0.0),
    )
