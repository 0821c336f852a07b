"""The clock: compilation apart, arrays waited for, ratios to the reference."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.benchmark import clock, reference_workload, seconds


def test_first_call_and_the_others_are_apart():
    traced = []

    def work(a):
        traced.append(None)
        time.sleep(0.1)  # when traced, not when run
        return a + 1

    work = jax.jit(work)
    took = clock(lambda: work(jnp.ones(3)), repeats=3)
    assert len(traced) == 1
    assert took.first > 0.1
    assert took.low <= took.median <= took.high < 0.1


def test_a_sleep_takes_as_long_as_it_takes():
    """At least what was slept; more where the machine is busy, so no upper bound."""
    took = clock(lambda: time.sleep(0.01), repeats=3)
    assert took.low >= 0.01
    assert seconds(lambda: time.sleep(0.01), calls=3) >= 0.01


def test_twice_the_reference_is_twice_the_ratio():
    """By turns, so a busy machine falls on both; a factor of 1.7 either way is noise."""
    reference = reference_workload()
    once = clock(reference, repeats=9).ratio
    twice = clock(lambda: (reference().block_until_ready(), reference()), 9).ratio
    assert 1 / 1.7 < once < 1.7
    assert 2 / 1.7 < twice < 2 * 1.7


def test_the_reference_is_the_same_every_time():
    work = reference_workload()
    # Sums of a million numbers by several threads, added up as they come.
    np.testing.assert_allclose(work(), work(), rtol=1e-4)
