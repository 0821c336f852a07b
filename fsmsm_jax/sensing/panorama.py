"""Any real scan, brought to N equiangular rays over the full circle.

Spectra want rays at −π + 2πn/N; real sensors give 180° in half degrees, [0, 2π)
clockwise, [−π, π] with one direction twice, or whatever was left after the zeros.
`panorama` looks up, for each wanted direction, the valid rays before and after it:

- two echoes of **one surface** give the point where the wanted ray crosses the chord
  between them, which is exact on a flat wall however coarse the sensor is;
- otherwise the **nearer** of the two rays speaks, echo or no echo: halfway over a
  jump in depth there is nothing, so nothing is invented there;
- with no valid ray close by, the wanted ray is **invalid**.

Two echoes are one surface when a wall seen under at most 75° from its normal could
make their step in range: along a wall at incidence α, dr/dφ = r tan α.
"""

import jax.numpy as jnp
import numpy as np

from fsmsm_jax import geometry
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["panorama"]

_STEEPEST = 3.7  # tan 75°: flatter views of a wall are rare, jumps in depth are not
_REACH = 0.75  # of a spacing: ½ covers even rays exactly, the rest forgives jitter
_MAX_REACH = np.pi / 4  # one lone ray says little about the rest of the circle
_SAME = 1e-5  # [rad]: directions that differ by less differ by rounding


def panorama(scan: Scan, rays: int) -> Scan:
    """The scan as seen by `rays` equiangular rays, ray n at bearing −π + 2πn/rays.

    Args:
        scan: rays in any directions and order, denser or sparser than asked for.
        rays: how many rays to make; static under `jit`.

    Returns:
        A scan over the full circle. A ray is invalid when no valid ray of `scan`
        lies within ¾ of the wider of two spacings, the median one of `scan`'s
        directions and the one asked for (45° at most); invalid and echoless rays read
        `range_max`.

    Raises:
        ValueError: fewer than 3 rays are asked for.

    Example:
        >>> half = Scan.from_ranges(np.full(181, 2.0), -np.pi / 2, np.pi / 180)
        >>> full = panorama(half, 8)
        >>> full.valid.tolist()
        [False, False, True, True, True, True, True, False]

    Note:
        O((n + rays) log n). For a batch, `vmap` over the leaves of `scan`.
    """
    if rays < 3:
        raise ValueError(f"a panorama needs at least 3 rays, got {rays}")
    wanted = np.linspace(-np.pi, np.pi, rays, endpoint=False)
    wanted = jnp.asarray(wanted, scan.bearings.dtype)
    bearings = geometry.wrap(scan.bearings)

    # The valid rays around each wanted one; the invalid are sorted out of the circle.
    keys = jnp.where(scan.valid, bearings, jnp.inf)
    order = jnp.argsort(keys)
    count = jnp.maximum(jnp.sum(scan.valid), 1)
    place = jnp.searchsorted(keys[order], wanted, side="right")
    before, after = order[(place - 1) % count], order[place % count]
    back = jnp.mod(wanted - bearings[before], 2 * jnp.pi)
    ahead = jnp.mod(bearings[after] - wanted, 2 * jnp.pi)
    nearer = jnp.where(back <= ahead, before, after)

    reach = jnp.maximum(_spacing(bearings), 2 * jnp.pi / rays) * _REACH
    reach = jnp.minimum(reach, _MAX_REACH)
    valid = scan.valid[nearer] & (jnp.minimum(back, ahead) <= reach)
    echo = valid & scan.echo[nearer]

    r_before, r_after = scan.ranges[before], scan.ranges[after]
    apart = back + ahead
    one_surface = (
        (scan.echo[before] & scan.echo[after])
        & (apart <= 2 * reach)
        & (
            jnp.abs(r_before - r_after)
            <= _STEEPEST * apart * jnp.minimum(r_before, r_after)
        )
    )
    # Law of sines: where the wanted ray crosses the chord between the two echoes.
    area = jnp.sin(ahead) * r_after + jnp.sin(back) * r_before
    usable = one_surface & (area > 0)
    chord = jnp.sin(apart) * r_before * r_after / jnp.where(usable, area, 1.0)
    ranges = jnp.where(usable, chord, scan.ranges[nearer])
    return Scan(
        ranges=jnp.where(echo, ranges, scan.range_max),
        bearings=wanted,
        valid=valid,
        echo=echo,
        range_max=scan.range_max,
    )


def _spacing(bearings):
    """Median angle from one direction to the next [rad].

    Directions, not rays: those that only fill an array up (`buckets`) repeat one.
    """
    around = jnp.sort(bearings)
    gaps = jnp.diff(around, append=around[:1] + 2 * jnp.pi)
    directions = jnp.sum(gaps > _SAME)
    sizes = jnp.sort(jnp.where(gaps > _SAME, gaps, jnp.inf))
    return 0.5 * (sizes[(directions - 1) // 2] + sizes[directions // 2])
