r"""A scan takes time, and a robot that turns meanwhile smears it.

A lidar of 7 turns a second on a robot that turns by 60° a second sees the last ray of a
scan 8° away from where it saw the first. With the motion known, each end point can be
carried into the frame of one moment. The motion is taken as a constant twist
ξ = (v, ω): between two moments a share m of it is done, exp(m ξ), an arc of a circle.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fsmsm_jax import geometry
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["fraction", "moments", "unswept"]

_LONGEST = 1.0  # [s] between scans: over a longer gap no twist is constant
_STRAIGHT = 1e-4  # [rad]: an arc flatter than this is its chord, to float32's precision


def fraction(motion: Float[Array, "3"], share: Float[Array, ""]) -> Float[Array, "3"]:
    """A share of a motion [m, m, rad]: the pose on its arc, before (< 0) or after.

    Example:
        >>> quarter = jnp.array([1.0, 1.0, jnp.pi / 2])  # of a circle of radius 1
        >>> [round(v, 3) for v in fraction(quarter, jnp.asarray(-1.0)).tolist()]
        [-1.0, 1.0, -1.571]
    """
    # A chord of an arc of angle θ leaves at θ/2 and measures 2 R sin(θ/2).
    theta = geometry.wrap(motion[2])
    half, part = theta / 2, share * theta / 2
    straight = jnp.abs(theta) < _STRAIGHT
    safe = jnp.where(straight, 1.0, half)
    ratio = jnp.where(straight, share, jnp.sin(share * safe) / jnp.sin(safe))
    turn = part - half
    c, s = jnp.cos(turn), jnp.sin(turn)
    x, y = motion[0], motion[1]
    return jnp.stack(
        [ratio * (c * x - s * y), ratio * (s * x + c * y), geometry.wrap(2 * part)]
    )


def unswept(
    scan: Scan, motion: Float[Array, "3"], moments: Float[Array, "rays"]
) -> Scan:
    """The scan as it would have been taken all at one moment.

    Args:
        scan: the scan as it was taken, on the way.
        motion: of the lidar over some interval [m, m, rad]: its pose at the end of the
            interval, in the frame of its pose at the beginning.
        moments: when each ray was taken, counted in such intervals from the moment
            that is wanted: −1 is one interval before it, 0 is that moment itself.

    Returns:
        The scan in the frame of the lidar at that moment; its rays may no longer be
        equiangular. What was not to be seen from there stays in it.
    """

    def move(moment, r, bearing, echo, point):
        there = fraction(motion, moment)
        moved = geometry.transform_points(there, point)
        return (
            jnp.where(echo, jnp.hypot(moved[0], moved[1]), r),
            jnp.where(echo, jnp.arctan2(moved[1], moved[0]), bearing + there[2]),
        )

    ranges, bearings = jax.vmap(move)(
        moments, scan.ranges, scan.bearings, scan.echo, scan.points
    )
    return Scan(
        ranges=jnp.minimum(ranges, scan.range_max),
        bearings=geometry.wrap(bearings),
        valid=scan.valid,
        echo=scan.echo & (ranges < scan.range_max),
        range_max=scan.range_max,
    )


def moments(
    stamps: Float[np.ndarray, "scans"], ray_times: Float[np.ndarray, "scans rays"]
) -> Float[np.ndarray, "scans rays"]:
    """When each ray was taken, in intervals between this scan and the one before.

    Args:
        stamps: times of the scans [s].
        ray_times: of each ray, after its scan's stamp [s] (`ScanLog.ray_times`).

    Returns:
        For `unswept`; 0 (leave the scan as it is) for the first scan, where time stands
        still or goes backwards, and over gaps of more than a second.
    """
    interval = np.diff(stamps, prepend=np.nan)
    usable = (interval > 0) & (interval <= _LONGEST)
    share = np.where(usable, 1 / np.where(usable, interval, 1.0), 0.0)
    return np.nan_to_num(ray_times) * share[:, None]
