"""CAER, the cumulative absolute error per ray: how badly two scans disagree.

The sum over rays of |S_R[n] − S_V[n]| (thesis eq. 6.32) is the metric by which every
method of the thesis chooses among candidates, and the objective that refinement
descends. It is a sum of metres over the valid rays; thresholds are stated per ray, so
that they mean the same for 360 rays and for 1 081.

One person in the room adds metres to a handful of rays. `truncated_caer_per_ray` lets
no ray count for more than `limit`: a ray is right or wrong, not very wrong. Other
forms, smooth, robust or aware of the sensor, charge a ray by another kernel than |e|
(see `kernels`).
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax.alignment.kernels import Absolute, Kernel
from fsmsm_jax.sensing import Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["caer", "caer_at", "caer_per_ray", "truncated_caer_per_ray"]


def caer(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    mask: Bool[Array, "rays"] | None = None,
    kernel: Kernel = Absolute(),
) -> Float[Array, ""]:
    r"""Cumulative absolute error, $\sum_n |S_R[n] - S_V[n]|$ [m] (thesis eq. 6.32).

    Args:
        ranges: real scan [m].
        virtual: virtual scan [m], same rays.
        mask: the rays that count; all of them if left out.
        kernel: what a ray costs, instead of |S_R − S_V|.

    Example:
        >>> real, virtual = jnp.array([1.0, 2.0, 9.0]), jnp.array([1.5, 2.0, 3.0])
        >>> float(caer(real, virtual)), float(caer(real, virtual, real < 5))
        (6.5, 0.5)
    """
    return jnp.sum(kernel.cost(ranges - virtual), where=mask)


def caer_per_ray(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    mask: Bool[Array, "rays"] | None = None,
) -> Float[Array, ""]:
    """Mean absolute error over the valid rays [m].

    Infinite if no ray is valid: a scan that says nothing never wins a ranking.
    """
    return truncated_caer_per_ray(ranges, virtual, jnp.inf, mask)


def truncated_caer_per_ray(
    ranges: Float[Array, "rays"],
    virtual: Float[Array, "rays"],
    limit: float | Float[Array, ""],
    mask: Bool[Array, "rays"] | None = None,
) -> Float[Array, ""]:
    """Mean over the valid rays of the absolute error, each capped at `limit` [m].

    Infinite if no ray is valid; otherwise at most `limit`.

    Example:
        >>> real, virtual = jnp.array([1.0, 2.0, 9.0]), jnp.array([1.5, 2.0, 3.0])
        >>> round(float(truncated_caer_per_ray(real, virtual, 0.25)), 3)
        0.167
    """
    count = ranges.size if mask is None else jnp.sum(mask)
    total = jnp.sum(jnp.minimum(jnp.abs(ranges - virtual), limit), where=mask)
    return jnp.where(count > 0, total / jnp.maximum(count, 1), jnp.inf)


def caer_at(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    kernel: Kernel = Absolute(),
) -> Float[Array, ""]:
    """CAER [m] of a scan against what the world looks like from a pose.

    The virtual scan is cast at the scan's own bearings and capped at its `range_max`.
    A ray without echo reads `range_max` itself, so it costs nothing where the map is
    free that far, and what is missing where the map has a wall before that.

    Args:
        world: an `OccupancyGrid` or a `PolygonMap`.
        scan: real scan, any field of view; invalid rays count nothing.
        pose: [x, y, θ] of the sensor in the map frame [m, m, rad].
        kernel: what a ray costs: `Absolute` for CAER itself, `PseudoHuber` for a
            smooth minimum, `GemanMcClure` or `Truncated` where some rays are wrong,
            `BeamModel` where people shorten them.

    Example:
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> scan = Scan.from_ranges([2.0, 1.5, float("inf")], 0.0, jnp.pi / 2)
        >>> round(float(caer_at(room, scan, jnp.array([3.0, 2.5, 0.0]))), 3)
        28.0

    Note:
        Differentiable in `pose` by the exact derivative of `raycast`, forward and
        reverse; the gradient is finite everywhere, 0 for rays that agree, and blind to
        walls that come into view behind others.
    """
    virtual = raycast(world, pose, scan.bearings, scan.range_max)
    return caer(scan.ranges, virtual, scan.valid, kernel)
