"""One, or many, or very many: batches in blocks of a size that one program serves.

An engine is compiled for a block of 64: enough to fill vectors, few enough for the
cache. A longer batch is cut into such blocks, the last one filled up, so that another
number of scans is not another compilation. What goes on around the engine is compiled
for the whole batch; `room_for` says how long to make it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.sensing.buckets import bucket, power_of_two

__all__ = ["as_batch", "cut", "first", "in_blocks", "room_for"]

_TOGETHER = 64

# Compiled, since array by array they would take as long as a match itself.
as_batch = jax.jit(lambda tree: jax.tree.map(lambda a: a[None], tree))
"""A batch of one."""
first = jax.jit(lambda tree: jax.tree.map(lambda a: a[0], tree))
"""The first of a batch."""
_some = jax.jit(lambda tree, index: jax.tree.map(lambda a: a[index], tree))


def room_for(count: int) -> int:
    """Length of a batch for so many: a power of two, or a bucket of whole blocks.

    Example:
        >>> [room_for(n) for n in (1, 3, 60, 65, 300, 1025)]
        [1, 4, 64, 128, 320, 1152]
    """
    if count <= _TOGETHER:
        return power_of_two(count)
    return bucket(-(-count // _TOGETHER) * _TOGETHER)


def in_blocks(run: Callable[[Any], Any], jobs: Any, count: int) -> Any:
    """The results of `run`, for a pytree of jobs along a leading axis of `count`."""
    if count <= _TOGETHER:
        return run(jobs)
    index = np.minimum(np.arange(-(-count // _TOGETHER) * _TOGETHER), count - 1)
    blocks = np.split(index, len(index) // _TOGETHER)
    done = [run(_some(jobs, block)) for block in blocks]
    return cut(jax.tree.map(lambda *parts: jnp.concatenate(parts), *done), count)


def cut(found: Any, count: int) -> Any:
    """The first `count` of a batch's results; what was added is dropped."""
    if len(jax.tree.leaves(found)[0]) == count:
        return found
    # By way of the host: slices on the device, and asarray, are programs, one a length.
    return jax.device_put(jax.tree.map(lambda a: np.asarray(a)[:count], found))
