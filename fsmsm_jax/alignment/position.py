r"""Position: the first-harmonic control law and its iteration.

Turn a scan's ray n into a unit vector $u_n$ along its heading $a_n = \hat\theta - \pi +
2\pi n / N$. Where the virtual ranges exceed the real ones the robot stands further
that way than believed, so the sum of $u_n (v_n - r_n)$ points from the estimate to the
truth. It is the first harmonic of $r - v$, whence the law's name.

How far to go: seen from the middle of a round room, a small step δ shortens ray n by
$u_n \cdot δ$, and least squares over all rays asks for

$$\Big(\sum_n u_n u_n^T\Big) δ = \sum_n u_n (v_n - r_n), \qquad
\sum_n u_n u_n^T = \tfrac{N}{2} I .$$

The thesis's law takes half of that step, 1/N instead of 2/N. Half is what keeps it
stable: a wall met at incidence α shortens by 1/cos α times more. So a circle is
approached by half the distance each time. Theorem I: without noise and with the right
heading the position converges. It does so where ranges change continuously on the way;
around a corner, a jump of J metres in one ray can hold the pose 2J/N away from the
truth, and the CAER that stays high betrays it.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax.alignment.spectrum import first_harmonic
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = [
    "Translation",
    "masked_position_correction",
    "position_correction",
    "translate",
]

_AT_REST = 1e-7  # [m] ε_u: a step shorter than this is the last
_EVENNESS = 0.1  # share of the rays that count as spread evenly, so that no fan is flat


def position_correction(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    theta: Float[Array, ""],
) -> Float[Array, "2"]:
    r"""One step of the control law, from two full panoramic scans.

    With $X_1$ the first harmonic of $S_R - S_V$,

    $$u = \frac{1}{N} \begin{bmatrix} \cos\hat\theta & \sin\hat\theta \\
    \sin\hat\theta & -\cos\hat\theta \end{bmatrix}
    \begin{bmatrix} \Re X_1 \\ \Im X_1 \end{bmatrix} .$$

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        virtual: virtual scan [m] from the pose estimate, same rays.
        theta: heading estimate [rad].

    Returns:
        The step (dx, dy) to add to the position estimate, map frame [m].

    Example:
        >>> bearings = -jnp.pi + jnp.pi / 2 * jnp.arange(4)
        >>> virtual = 2.0 + 0.2 * jnp.cos(bearings)  # too much room ahead
        >>> step = position_correction(jnp.full(4, 2.0), virtual, jnp.asarray(0.5))
        >>> [round(s, 3) for s in step.tolist()]  # 0.1 m along the heading
        [0.088, 0.048]

    Reference:
        tc_x1, Algorithm XIX of the thesis, eq. 4.30 (erratum E9: right for rays that
        start at −π).
    """
    X1 = first_harmonic(ranges - virtual)
    c, s = jnp.cos(theta), jnp.sin(theta)
    return (
        jnp.stack([c * X1.real + s * X1.imag, s * X1.real - c * X1.imag]) / ranges.size
    )


def masked_position_correction(
    ranges: Float[Array, "rays"],
    mask: Bool[Array, "rays"],
    virtual: Float[Array, "rays"],
    theta: Float[Array, ""],
) -> Float[Array, "2"]:
    r"""The control law for any field of view: half the least-squares step.

    Solves $\sum m_n u_n u_n^T\, δ = \tfrac12 \sum m_n u_n (v_n - r_n)$. In complex
    numbers, with $w_n = e^{i a_n}$, $M = \sum m_n$, $z = \sum m_n w_n^2$ and
    $b = \sum m_n w_n (v_n - r_n)$, the solution is
    $δ = (M b - z \bar b) / (M^2 - |z|^2)$; a full mask has z = 0 and gives
    `position_correction`.

    Args:
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        mask: the rays that both scans know.
        virtual: virtual scan [m] from the pose estimate, same rays.
        theta: heading estimate [rad].

    Returns:
        The step (dx, dy) to add to the position estimate, map frame [m]. Zero without
        valid rays, and never longer than ten times the largest |v − r|: |z| is held
        under 0.9 M, as if a tenth of the rays looked evenly around, which matters for
        fields of view below 45° and for lone rays.

    Example:
        >>> bearings = -jnp.pi + jnp.pi / 4 * jnp.arange(8)
        >>> virtual = 2.0 + 0.2 * jnp.cos(bearings)
        >>> ahead = jnp.abs(bearings) < 2
        >>> step = masked_position_correction(
        ...     jnp.full(8, 2.0), ahead, virtual, jnp.asarray(0.5)
        ... )
        >>> [round(s, 3) for s in step.tolist()]
        [0.088, 0.048]
    """
    d = jnp.where(mask, virtual - ranges, 0.0)
    m = mask.astype(d.dtype)
    a = theta + _bearings(ranges.size, d.dtype)
    w = jax.lax.complex(jnp.cos(a), jnp.sin(a))
    M, z, b = jnp.sum(m), jnp.sum(m * w**2), jnp.sum(d * w)
    limit = (1 - _EVENNESS) * M
    z = z * (limit / jnp.maximum(jnp.abs(z), jnp.maximum(limit, 1e-9)))
    spread = M**2 - jnp.abs(z) ** 2
    step = (M * b - z * jnp.conj(b)) / jnp.where(spread > 0, spread, 1.0)
    return jnp.stack([step.real, step.imag])


class Translation(NamedTuple):
    """What `translate` found."""

    pose: Float[Array, "3"]
    """The pose after the last step, heading as given."""
    least: Float[Array, "3"]
    """Of the poses scanned (so not the last), the one with the least CAER."""
    caers: Float[Array, "iterations"]
    """CAER [m] at the start of each iteration, gated rays included."""
    stayed: Bool[Array, ""]
    """Whether every pose after a step lay inside the map and within `reach`."""


def translate(
    world: OccupancyGrid | PolygonMap,
    ranges: Float[Array, "rays"],
    pose: Float[Array, "3"],
    iterations: int,
    mask: Bool[Array, "rays"] | None = None,
    gate: float | Float[Array, ""] = math.inf,
    range_max: float | Float[Array, ""] = 30.0,
    reach: float | Float[Array, ""] = math.inf,
    cap: float | Float[Array, ""] = math.inf,
) -> Translation:
    """Walk to where the virtual scan looks like the real one, heading held.

    Args:
        world: an `OccupancyGrid` or a `PolygonMap`.
        ranges: real scan [m], ray n at bearing −π + 2πn/N.
        pose: estimate [x, y, θ] in the map frame [m, m, rad].
        iterations: number of casts and steps; static.
        mask: valid rays of the real scan; if left out all are, and the plain law moves.
        gate: rays that differ by more than gate · N · (length of the last step, 1/N m
            at first) do not move the pose. The thesis's program has 0.25; its text has
            no gate, which is infinity.
        range_max: cap of the virtual ranges [m], the sensor's own.
        reach: how far from its start the pose may go [m], in x and in y; only noted,
            in `stayed`.
        cap: rays that differ by more [m] never move the pose, and count no more than
            this in CAER: people, open doors, glass.

    Example:
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> bearings = jnp.linspace(-jnp.pi, jnp.pi, 90, endpoint=False)
        >>> ranges = raycast(room, jnp.array([3.0, 2.0, 0.5]), bearings)
        >>> found = translate(room, ranges, jnp.array([2.0, 3.0, 0.5]), 30)
        >>> [round(v, 3) for v in found.pose.tolist()]
        [3.0, 2.0, 0.5]

    Reference:
        tc_x1, Algorithm XIX of the thesis, with ε_u = 1e-7 m: after a shorter step the
        pose rests. The gate is in its program only; closed below 0.1 mm, it opens to
        1 m.

    Note:
        Linear convergence, about ½ an iteration. Nothing keeps the pose inside the
        map: look at `stayed`.
    """
    rays = ranges.size
    bearings = _bearings(rays, pose.dtype)

    def step(carry, _):
        pose, length = carry
        virtual = raycast(world, pose, bearings, range_max)
        bound = gate * rays * jnp.maximum(length, jnp.finfo(length.dtype).tiny)
        bound += jnp.where(bound < 1e-4, 1.0, 1e-6)
        bound = jnp.minimum(bound, cap)
        # A gated ray agrees by decree: it does not pull, but still counts in 1/N.
        near = jnp.where(jnp.abs(ranges - virtual) <= bound, virtual, ranges)
        if mask is None:
            u = position_correction(ranges, near, pose[2])
        else:
            u = masked_position_correction(ranges, mask, near, pose[2])
        u = jnp.where(length < _AT_REST, 0.0, u).astype(pose.dtype)
        after = pose.at[:2].add(u)
        near_start = jnp.all(jnp.abs(after[:2] - start[:2]) <= reach)
        stayed = near_start & world.contains(after[:2])
        off = jnp.minimum(jnp.abs(ranges - virtual), cap)
        return (after, jnp.linalg.norm(u)), (pose, jnp.sum(off, where=mask), stayed)

    start = pose
    begin = (pose, jnp.asarray(1 / rays, pose.dtype))
    (last, _), (poses, caers, stayed) = jax.lax.scan(step, begin, length=iterations)
    return Translation(last, poses[jnp.argmin(caers)], caers, jnp.all(stayed))


def _bearings(rays: int, dtype) -> Float[Array, "rays"]:
    """−π + 2πn/rays [rad]."""
    return jnp.asarray(np.linspace(-np.pi, np.pi, rays, endpoint=False), dtype)
