"""Scans and batches of few shapes, so that few programs are compiled.

A fleet brings scans of 180, 181, 360, 682, 720 and 1 081 rays, logs lose rays, batches
have any length: left alone, each would be a program of its own, seconds to compile. So
shapes are rounded up on the host, before any program sees them:

- rays to their `bucket`, an eighth more at most and 6 % with common sensors
  (180 → 192, 360 and 361 → 384, 720 → 768, 1 081 → 1 152);
- batches to powers of two: their programs are dear and batches are short, so few sizes
  are worth more than full ones. The last item is repeated, its copies' results cut off.

A ray that is added says nothing: it is not valid, reads `range_max` like every ray of
that kind, and points where the last ray points, so that no direction is new.
"""

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Shaped

from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.sizes import bucket

__all__ = ["bucket", "filled", "padded", "padded_rays", "power_of_two", "stacked"]

_T = TypeVar("_T")


def power_of_two(size: int) -> int:
    """The power of two that is not less: the bucket of a batch.

    Example:
        >>> [power_of_two(n) for n in (1, 2, 3, 8, 9)]
        [1, 2, 4, 8, 16]
    """
    return 1 << max(size - 1, 0).bit_length()


def padded(scan: Scan, rays: int | None = None) -> Scan:
    """The scan with rays that say nothing appended, up to its bucket.

    Args:
        scan: one scan, or many along leading axes.
        rays: how many to have; the `bucket` of those that it has, if left out.

    Returns:
        A scan of NumPy arrays, for a jitted function; the scan itself if it is of that
        size. Not for a scan that is being traced.

    Raises:
        ValueError: the scan has more rays than that.

    Example:
        >>> scan = Scan.from_ranges([2.0, 3.0, 4.0], 0.0, 0.1)
        >>> longer = padded(scan)
        >>> longer.valid.tolist()
        [True, True, True, False, False, False, False, False]
    """
    ranges = np.asarray(scan.ranges)
    count = ranges.shape[-1]
    more = (bucket(count) if rays is None else rays) - count
    if more < 0:
        raise ValueError(f"a scan of {count} rays does not fit in {rays}")
    if more == 0:
        return scan
    far = np.asarray(scan.range_max, ranges.dtype)[..., None]
    nothing = np.zeros((*ranges.shape[:-1], more), bool)
    longer = (
        np.concatenate([ranges, np.broadcast_to(far, nothing.shape)], axis=-1),
        padded_rays(scan.bearings, count + more),
        np.concatenate([np.asarray(scan.valid), nothing], axis=-1),
        np.concatenate([np.asarray(scan.echo), nothing], axis=-1),
    )
    # Not through the constructor, which takes device arrays of one scan.
    rays_of = lambda scan: (scan.ranges, scan.bearings, scan.valid, scan.echo)
    return eqx.tree_at(rays_of, scan, longer)


def padded_rays(
    values: Array | Shaped[np.ndarray, "*batch rays"], rays: int
) -> Shaped[np.ndarray, "*batch {rays}"]:
    """Values by ray, such as `moments`, the last repeated up to so many rays."""
    values = np.asarray(values)
    more = rays - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, more)], mode="edge")


def filled(batch: _T, size: int) -> _T:
    """A pytree of stacked items, the last repeated until there are `size` of them.

    NumPy arrays come back; the batch itself if it is of that size.
    """
    if len(jax.tree.leaves(batch)[0]) == size:
        return batch

    def fill(leaf):
        leaf = np.asarray(leaf)
        last = np.broadcast_to(leaf[-1:], (size - len(leaf), *leaf.shape[1:]))
        return np.concatenate([leaf, last])

    return jax.tree.map(fill, batch)


def stacked(scans: Sequence[Scan]) -> Scan:
    """Scans of any lengths along a leading axis, padded to the longest one's bucket.

    NumPy arrays throughout.
    """
    rays = max(bucket(scan.ranges.shape[-1]) for scan in scans)
    level = [padded(scan, rays) for scan in scans]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *level)
