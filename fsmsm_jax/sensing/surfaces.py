r"""What of a scan is wall, and which way it faces: the reference's noise, taken out.

The end points of a noisy scan, joined up, are a saw. Its teeth face anywhere, and
derivatives of a cast on it are of the noise. But behind them are walls, and a straight
wall has a simple form in polar coordinates,

$$1 / r(\varphi) = a \cos(\varphi - \varphi_n) + b \sin(\varphi - \varphi_n),$$

so that over any window of rays it is least squares with two unknowns: around ray n the
range is 1/a and its slope dr/dφ is −b/a². Each ray asks windows of many widths, around
it, before it and after it. Those across an edge fit badly: worse than the noise, which
the scan's second differences tell. Of those that fit, the one that fixes the range best
is believed: a long one on a wall, a one-sided one beside an edge, and beside a pole
none, which leaves the ray as it was measured.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax.sensing.lidar import Scan

__all__ = ["Surfaces", "surfaces"]

_WIDEST = 20  # the longest window reaches a twentieth of the circle to either side
_BEYOND = 2.0  # standard errors by which a window may fit worse than the noise
_ROUNDING = 1e-3  # of the range: a fit may be off by this, which float32 cannot tell
_FINEST, _COARSEST = 5e-4, 0.3  # [m] noise: less is rounding, more is no lidar's
_MEDIAN = 0.67449 * math.sqrt(1.5)  # of |second differences|, for noise of variance 1
_QUARTILE = 0.31864 * math.sqrt(1.5)
_AGREED = 1.5  # times what the quartile says is the most that the median may
_NARROW = 1e-3  # [1/m] least inverse range of a fit: farther than a kilometre is none
_NEAREST = 0.01  # [m] least range that is inverted
_STEEPEST = 3.7  # tan 75°, as for `panorama`
_JUMP = 4.0  # standard deviations that neighbours on one wall may differ besides


class Surfaces(NamedTuple):
    """The walls behind the rays of a panorama."""

    ranges: Float[Array, "rays"]
    """Range to the wall [m]; as measured where none was made out."""
    slope: Float[Array, "rays"]
    """Its slope dr/dφ [m/rad]; 0 where none was made out."""
    share: Float[Array, "rays"]
    """Variance that is left of a ray's noise: 1/n after a window of n rays, or 1."""
    slope_share: Float[Array, "rays"]
    """Variance of the slope over that of a range [1/rad²]; 0 where none was made
    out."""
    solid: Bool[Array, "rays"]
    """Whether something stands all the way from ray n to ray n + 1: both are echoes,
    and no jump is between them."""
    noise: Float[Array, ""]
    """Standard deviation of a range, as the scan itself shows it [m]."""


def surfaces(panorama: Scan) -> Surfaces:
    """Walls through the echoes of a scan.

    Args:
        panorama: N equiangular rays over the full circle (`sensing.panorama`).

    Example:
        >>> from fsmsm_jax import PolygonMap, panorama, raycast
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> bearings = jnp.linspace(-jnp.pi, jnp.pi, 360, endpoint=False)
        >>> exact = raycast(room, jnp.array([2.5, 2.0, 0.3]), bearings)
        >>> noise = 0.03 * np.random.default_rng(0).normal(size=360)
        >>> found = surfaces(panorama(Scan.from_bearings(exact + noise, bearings), 360))
        >>> left = jnp.std(found.ranges - exact)
        >>> bool(0.02 < found.noise < 0.04), bool(left < 0.015)
        (True, True)

    Note:
        Pure, for `vmap`. A wall that is round is taken for short straight ones.
    """
    ranges, echo = panorama.ranges, panorama.echo
    spacing = 2 * np.pi / ranges.size
    noise = _noise(ranges, echo)
    smooth, slope, share, slope_share = _best_fits(ranges, echo, noise, spacing)
    following = jnp.roll(smooth, -1)
    # What a wall seen at 75° from its normal might step, and what noise might.
    step = _STEEPEST * spacing * jnp.minimum(smooth, following)
    near = jnp.abs(following - smooth) <= step + _JUMP * noise
    solid = near & echo & jnp.roll(echo, -1)
    return Surfaces(smooth, slope, share, slope_share, solid, noise)


def _noise(ranges, echo):
    """From second differences, which no straight and hardly any other wall has.

    Their median tells best, but in clutter, where half of the rays jump, it tells of
    jumps; their quartile, of rays that still lie on walls, shows that.
    """
    second = jnp.abs(ranges - 0.5 * (jnp.roll(ranges, 1) + jnp.roll(ranges, -1)))
    known = echo & jnp.roll(echo, 1) & jnp.roll(echo, -1)
    rising, count = jnp.sort(jnp.where(known, second, jnp.inf)), jnp.sum(known)
    median, quartile = rising[count // 2], rising[count // 4]
    noise = jnp.minimum(median / _MEDIAN, _AGREED * quartile / _QUARTILE)
    return jnp.clip(jnp.where(count > 0, noise, 0.0), _FINEST, _COARSEST)


def _best_fits(ranges, echo, noise, spacing):
    """Range, slope and the shares of each ray, by the best window it is in."""
    # Weights and inverse ranges from the middle of five: it keeps edges, and does not
    # follow the ray's own noise, which would pull the fit to where it is small.
    middle = jnp.maximum(_median_of_five(ranges), _NEAREST)
    off = jnp.clip(ranges - middle, -0.5 * middle, 0.5 * middle)
    inverse, weight = 1 / middle - off / middle**2, middle**4

    windows, offsets = _windows(ranges.size)
    c, s = np.cos(offsets * spacing), np.sin(offsets * spacing)
    total = lambda f, x: jnp.asarray(windows * f, ranges.dtype) @ _around(x, offsets)
    cc, cs, ss = (total(f, weight) for f in (c * c, c * s, s * s))
    yc, ys = (total(f, weight * inverse) for f in (c, s))
    yy = total(1.0, weight * inverse**2)
    det = jnp.maximum(cc * ss - cs**2, jnp.finfo(ranges.dtype).tiny)
    a, b = (ss * yc - cs * ys) / det, (cc * ys - cs * yc) / det

    width = windows.sum(axis=1)[:, None]
    misfit = (yy - a * yc - b * ys) / (width - 2)
    allowed = noise**2 * (1 + _BEYOND * np.sqrt(2 / (width - 2)))
    allowed = allowed + (_ROUNDING * middle[None]) ** 2
    inside = total(1.0, echo.astype(ranges.dtype)) >= width - 0.5
    sound = inside & (misfit <= allowed) & (a > _NARROW)
    a = jnp.where(sound, a, 1.0)
    share = jnp.where(sound, ss / det / a**4, jnp.inf)
    best = jnp.argmin(share, axis=0)
    take = lambda f: jnp.take_along_axis(f, best[None], axis=0)[0]
    made_out = take(share) < 1
    return (
        jnp.where(made_out, take(1 / a), ranges),
        jnp.where(made_out, take(-b / a**2), 0.0),
        jnp.where(made_out, take(share), 1.0),
        jnp.where(made_out, take(cc / det / a**4), 0.0),
    )


def _windows(rays):
    """Which offsets from a ray are in each window, as 0 and 1, and the offsets."""
    halves = 2 ** np.arange(max(int(np.log2(max(rays / _WIDEST, 1))), 0) + 1)
    offsets = np.arange(-2 * halves[-1], 2 * halves[-1] + 1)
    windows = [np.abs(offsets - at) <= h for h in halves for at in (0, -h, h)]
    return np.array(windows, float), offsets


def _around(x, offsets):
    """Row k: each ray's neighbour at the k-th offset. Slices, not gathers: faster."""
    reach, rays = -offsets[0], x.size
    period = jnp.concatenate([x[rays - reach :], x, x[:reach]])
    return jnp.stack([period[k : k + rays] for k in range(len(offsets))])


def _median_of_five(x):
    """Of each ray and two to either side, by seven exchanges."""
    v = [jnp.roll(x, k) for k in (-2, -1, 0, 1, 2)]
    for i, j in ((0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)):
        v[i], v[j] = jnp.minimum(v[i], v[j]), jnp.maximum(v[i], v[j])
    return v[2]
