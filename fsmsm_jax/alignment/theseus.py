r"""Theseus: orientation finer than the rays, by casting between them.

Two scans can be turned against each other by whole rays only, which leaves up to γ/2.
The map, however, can be asked at any bearing. Theseus takes 2^ν virtual scans, each
γ/2^ν further round, corrects each as ever and keeps the one that agrees best: the
residue falls to γ/2^(1+ν). All of them are one cast of 2^ν N rays, dealt out in turn.

The bound is no guarantee, even without noise at the true position (erratum E5): at a
steep edge one ray off by metres outvotes the others. How often it holds in 400 star
rooms of 40 walls (`tests/alignment/test_theseus.py`), choosing as the thesis does, by
CAER, in which metres count once and not squared, and with Sinis:

| ν, share in %          | 0    | 1    | 2    | 3    |
|------------------------|------|------|------|------|
| most similar (thesis)  | 94.5 | 91.8 | 91.8 | 96.5 |
| least CAER             | 94.5 | 97.3 | 98.3 | 99.8 |
| Sinis                  | 94.5 | 91.3 | 83.3 | 72.3 |

With 0.2 m of noise CAER loses that lead, and at ν = 3 more than that (82 to 87 %).

Sinis, whom Theseus slew, bends the real scan instead: he invents the rays between the
measured ones. That is right along a wall and wrong across every edge, the more often
the finer it gets. He is here because the thesis explains Theseus by his failure.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import caer_per_ray
from fsmsm_jax.alignment.orientation import (
    METHODS,
    Orientation,
    fourier_mellin_masked,
    heading_costs,
    turned,
)
from fsmsm_jax.alignment.spectrum import Spectrum

__all__ = ["Candidates", "distinct_headings", "sinis", "theseus"]

_NEAR = 0.3  # [m] added to a range before its logarithm is taken


class Candidates(NamedTuple):
    """What may be added to the heading from which the virtual scan was cast."""

    corrections: Float[Array, "candidates"]
    """Angles to add to θ [rad], in [−π, π), one a sub-ray offset kγ/2^ν."""
    similarity: Float[Array, "candidates"]
    """Percent discrimination of each; the thesis takes the greatest."""
    caer: Float[Array, "candidates"]
    """Mean absolute difference per ray of each [m]; the least is right more often."""


def theseus(
    ranges: Float[Array, "rays"],
    fine_virtual: Float[Array, "fine"],
    method: str = "fourier_mellin",
    mask: Bool[Array, "rays"] | None = None,
) -> Candidates:
    r"""The 2^ν heading corrections that sub-ray virtual scans suggest.

    Virtual scan k holds the rays k, k + 2^ν, … of the fine one, so it is cast from the
    heading $\hat\theta + k \gamma / 2^\nu$, and what the method adds to that is
    $\hat\theta_k = \hat\theta + I_k \gamma + k \gamma / 2^\nu$.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        fine_virtual: one cast [m] from the pose estimate with 2^ν N rays, ray i at
            bearing −π + 2πi / (2^ν N).
        method: a name in `METHODS`.
        mask: valid rays of the real scan, for `fourier_mellin` only; all if left out.

    Returns:
        The candidates k = 0, …, 2^ν − 1. Take `corrections[argmax(similarity)]` as
        published, or `corrections[argmin(caer)]`; from a doubtful position neither, but
        step to each candidate's position first and compare then, as FSMSM does.

    Raises:
        ValueError: the fine scan has not 2^ν times as many rays, the method is unknown,
            or it cannot do with a mask.

    Example:
        >>> bearings = lambda rays: -jnp.pi + 2 * jnp.pi * jnp.arange(rays) / rays
        >>> room = lambda heading: 3 + jnp.cos(heading) + 0.5 * jnp.sin(3 * heading)
        >>> real = room(bearings(12) + 0.8)  # the estimate below is 0
        >>> found = theseus(real, room(bearings(8 * 12)))
        >>> best = found.corrections[jnp.argmax(found.similarity)]
        >>> round(float(best), 3), round(2 * float(jnp.pi) * 12 / 96, 3)
        (0.785, 0.785)

    Reference:
        rc_theseus, Algorithms XVII and XVIII of the thesis, eq. 4.25 to 4.28 of the
        draft, with erratum E4 (kγ/2^ν is added once).

    Note:
        For `first_principles` the candidates are 2^ν opinions on one continuous angle,
        for CAER to choose from; percent discrimination has no meaning there
        (Remark XIV). Differentiable as far as the method is.
    """
    steps = _steps(ranges, fine_virtual)
    correct = _method(method)
    if mask is not None:
        if method != "fourier_mellin":
            raise ValueError(
                f"{method!r} needs every ray: use 'fourier_mellin' with a mask"
            )
        everywhere = jnp.ones(ranges.shape, bool)
        correct = lambda r, v: fourier_mellin_masked(r, mask, v, everywhere)

    def candidate(virtual):
        found = correct(ranges, virtual)
        disagreement = caer_per_ray(ranges, turned(virtual, found.correction), mask)
        return found.correction, found.similarity, disagreement

    scans = fine_virtual.reshape(ranges.size, steps).T
    corrections, similarity, disagreement = jax.vmap(candidate)(scans)
    offsets = jnp.arange(steps) * (2 * jnp.pi / fine_virtual.size)
    corrections = geometry.wrap(corrections + offsets.astype(ranges.dtype))
    return Candidates(corrections, similarity, disagreement)


def distinct_headings(
    ranges: Float[Array, "rays"],
    fine_virtual: Float[Array, "fine"],
    centre: float | Float[Array, ""],
    half_width: float | Float[Array, ""],
    count: int,
    apart: float | Float[Array, ""],
    mask: Bool[Array, "rays"] | None = None,
    fine_mask: Bool[Array, "fine"] | None = None,
) -> Candidates:
    """The best heading corrections in a sector that are apart from each other.

    Theseus looks about one peak; a square room has four alike and a corridor two. Here
    all 2^ν N headings are compared, by the mean squared difference of log(range + 0.3),
    for which a metre counts less the farther it is: no long ray votes like fifty.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        fine_virtual: one cast [m] with 2^ν N rays, as in `theseus`.
        centre: middle of the corrections that are possible [rad].
        half_width: how far from it they may lie [rad].
        count: how many to find; static. The best is repeated if there are fewer.
        apart: least angle between two of them [rad].
        mask: valid rays of the real scan; all if left out.
        fine_mask: rays of the virtual scan that know something; all if left out.

    Returns:
        The candidates, best first. Their similarity is 1 / (1 + cost), their `caer`
        the cost itself, of logarithms.

    Raises:
        ValueError: the fine scan has not 2^ν times as many rays.

    Example:
        >>> wave = 3 + jnp.cos(jnp.arange(36) * jnp.pi / 9)  # twice round: two answers
        >>> found = distinct_headings(wave, jnp.roll(wave, 3), 0.0, 4.0, 2, 0.5)
        >>> sorted(round(float(c), 2) for c in found.corrections)
        [-2.62, 0.52]
    """
    steps = _steps(ranges, fine_virtual)
    everywhere = jnp.ones(ranges.shape, bool)
    compress = lambda ranges: jnp.log(ranges + _NEAR)
    fine_mask = jnp.ones(fine_virtual.shape, bool) if fine_mask is None else fine_mask
    R = Spectrum.of(compress(ranges), everywhere if mask is None else mask)
    cost = lambda v, known: heading_costs(R, Spectrum.of(compress(v), known))
    dealt = lambda fine: fine.reshape(ranges.size, steps).T
    costs = jax.vmap(cost)(dealt(fine_virtual), dealt(fine_mask)).T.reshape(-1)
    turns = jnp.arange(fine_virtual.size) * (2 * jnp.pi / fine_virtual.size)
    turns = turns.astype(ranges.dtype)
    possible = jnp.abs(geometry.wrap(turns - centre)) <= half_width
    costs = jnp.where(possible, costs, jnp.inf)

    def take_best(costs, _):
        best = jnp.argmin(costs)
        beside = jnp.abs(geometry.wrap(turns - turns[best])) < apart
        return jnp.where(beside, jnp.inf, costs), (turns[best], costs[best])

    _, (found, least) = jax.lax.scan(take_best, costs, length=count)
    found = jnp.where(jnp.isfinite(least), found, found[0])
    return Candidates(geometry.wrap(found), 1 / (1 + least), least)


def sinis(
    ranges: Float[Array, "rays"],
    fine_virtual: Float[Array, "fine"],
    method: str = "fourier_mellin",
) -> Orientation:
    r"""Heading correction with invented rays: the way that does not work.

    Between neighbours of the real scan goes a ray of their mean range,
    $S'[n] = \frac12 (S_R[n] + S_R[n+1])$ at bearing nγ + γ/2, and so on ν times; the
    result is compared once with a virtual scan of as many rays.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        fine_virtual: one cast [m] from the pose estimate with 2^ν N rays, ray i at
            bearing −π + 2πi / (2^ν N).
        method: a name in `METHODS`.

    Returns:
        The correction, for the grid methods a multiple of γ/2^ν.

    Raises:
        ValueError: the fine scan has not 2^ν times as many rays, or the method is
            unknown.

    Example:
        >>> wave = 3 + jnp.sin(2 * jnp.pi * jnp.arange(64) / 64)
        >>> turn = sinis(wave[1::4], wave)  # the real scan is a sixteenth of a ray on
        >>> round(float(turn.correction * 64 / (2 * jnp.pi)), 3)
        1.0

    Reference:
        The method of Pityokamptes (Sinis), section 4.2.5 of the thesis's draft. The
        thesis raises ν only when the heading has come to rest; that is left to the
        caller.

    Note:
        Right along straight walls, nearly; wrong at every range jump, by amounts that
        no sampling degree reduces. Use `theseus`.
    """
    steps, fine = _steps(ranges, fine_virtual), ranges
    while fine.size < steps * ranges.size:
        between = 0.5 * (fine + jnp.roll(fine, -1))
        fine = jnp.stack([fine, between], axis=-1).reshape(-1)
    return _method(method)(fine, fine_virtual)


def _steps(ranges, fine_virtual):
    """How many times finer the virtual scan is, a power of two."""
    steps, rest = divmod(fine_virtual.size, ranges.size)
    if rest or steps.bit_count() != 1:
        raise ValueError(
            f"a real scan of {ranges.size} rays wants 2^ν times as many virtual ones, "
            f"not {fine_virtual.size}"
        )
    return steps


def _method(name):
    if name not in METHODS:
        raise ValueError(f"no method {name!r}: choose from {', '.join(METHODS)}")
    return METHODS[name]
