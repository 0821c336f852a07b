"""One, or many, or very many: batches in blocks of a size that one program serves.

An engine is compiled for a block of 64: enough to fill vectors, few enough for the
cache. A longer batch is cut into such blocks, the last one filled up, so that another
number of scans is not another compilation.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["as_batch", "first", "in_blocks"]

_TOGETHER = 64

# Compiled, since array by array they would take as long as a match itself.
as_batch = jax.jit(lambda tree: jax.tree.map(lambda a: a[None], tree))
"""A batch of one."""
first = jax.jit(lambda tree: jax.tree.map(lambda a: a[0], tree))
"""The first of a batch."""
_some = jax.jit(lambda tree, index: jax.tree.map(lambda a: a[index], tree))


def in_blocks(run: Callable[[Any], Any], jobs: Any, count: int) -> Any:
    """The results of `run`, for a pytree of jobs along a leading axis of `count`."""
    if count <= _TOGETHER:
        return run(jobs)
    index = np.minimum(np.arange(-(-count // _TOGETHER) * _TOGETHER), count - 1)
    blocks = np.split(index, len(index) // _TOGETHER)
    done = [run(_some(jobs, block)) for block in blocks]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *done)
