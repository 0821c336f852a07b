"""How long does it take? Asked so that the answer means something.

The first call of a jitted function traces and compiles it: that is timed apart. Arrays
come back before they are computed: the clock waits for them. One run is no measurement:
there are many, and the median is told with the quartiles. Short work is done several
times between two looks at the clock.

And since seconds of a machine that is shared mean little, work is also told in units of
a **reference workload**, some 20 ms on two cores of what localising is made of (FFTs,
products, gathers), timed in turn with it: whatever else the machine does falls on both.
"""

import functools
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["Clocked", "clock", "ratio_to_reference", "reference_workload", "seconds"]

_LOOK = 0.05  # [s] shortest time between two looks at the clock


class Clocked(NamedTuple):
    """Seconds of one call."""

    first: float
    """The first one, compilation included."""
    low: float
    """A quarter of the repetitions were faster."""
    median: float
    high: float
    """A quarter were slower."""
    ratio: float
    """Median of the time over the reference workload's, by turns."""
    ratio_low: float
    """Its lower quartile."""
    ratio_high: float
    """Its upper quartile."""


def seconds(work: Callable[[], object], calls: int = 1) -> float:
    """How long one of so many calls takes until its arrays are there [s]."""
    start = time.perf_counter()
    for _ in range(calls):
        jax.block_until_ready(work())
    return (time.perf_counter() - start) / calls


def clock(work: Callable[[], object], repeats: int = 15) -> Clocked:
    """Time work that has not run before, and then again and again.

    Example:
        >>> double = jax.jit(lambda a: 2 * a)
        >>> told = clock(lambda: double(jnp.ones(3)), repeats=3)
        >>> told.first > told.high >= told.median >= told.low > 0
        True
    """
    reference = reference_workload()
    first = seconds(work)
    calls = max(1, math.ceil(_LOOK / seconds(work)))
    turns = [(seconds(work, calls), seconds(reference)) for _ in range(repeats)]
    times, references = np.array(turns).T
    quartiles = np.percentile(times, (25, 50, 75))
    ratios = np.percentile(times / references, (50, 25, 75))
    return Clocked(first, *map(float, quartiles), *map(float, ratios))


def ratio_to_reference(work: Callable[[], object], repeats: int = 15) -> float:
    """Time of the work in units of the reference, the two timed in turn."""
    return clock(work, repeats).ratio


@functools.cache
def reference_workload() -> Callable[[], jax.Array]:
    """A fixed piece of work, compiled and run once."""

    @jax.jit
    def work(image, matrix, index):
        image = jax.lax.fori_loop(
            0, 8, lambda _, a: jnp.fft.irfft2(jnp.fft.rfft2(a) * 0.5), image
        )
        matrix = jax.lax.fori_loop(0, 8, lambda _, a: a @ a / len(a), matrix)
        return image.sum() + matrix.sum() + image.reshape(-1)[index].sum()

    keys = jax.random.split(jax.random.key(0), 3)
    image = jax.random.normal(keys[0], (512, 512))
    matrix = jax.random.normal(keys[1], (384, 384))
    index = jax.random.randint(keys[2], (1 << 19,), 0, image.size)
    jax.block_until_ready(work(image, matrix, index))
    return lambda: work(image, matrix, index)
