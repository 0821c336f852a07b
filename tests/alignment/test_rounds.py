"""The work queue against a plain Python loop over the jobs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.rounds import in_rounds


def collatz(state, job):
    """One step of the odd-even game on n; even numbers go to stage 1, odd to 0."""
    n, stage, steps = state
    after = jnp.where(n % 2 == 0, n // 2, 3 * n + 1)
    return after, jnp.where(after == 1, 2, 1 - after % 2), steps + job


def start(numbers):
    numbers = jnp.asarray(numbers)
    return numbers, jnp.where(numbers == 1, 2, 1 - numbers % 2), 0 * numbers


def by_hand(n):
    steps = 0
    while n != 1:
        n, steps = (n // 2 if n % 2 == 0 else 3 * n + 1), steps + 1
    return steps


@pytest.mark.parametrize("block", [1, 3, 8, 64])
def test_every_job_runs_to_its_own_end(block):
    numbers = np.array([1, 2, 27, 7, 6, 97, 5, 1])  # 0 to 118 steps
    weight = jnp.arange(8)
    run = jax.jit(
        lambda state, jobs: in_rounds(
            [collatz, collatz], lambda s: s[1], state, jobs, block
        )
    )
    n, stage, steps = run(start(numbers), weight)
    np.testing.assert_array_equal(n, 1)
    np.testing.assert_array_equal(stage, 2)
    np.testing.assert_array_equal(
        steps, np.array([by_hand(n) for n in numbers]) * weight
    )


def test_only_the_stage_of_a_round_runs():
    """A stage that nobody waits at must not even be able to spoil the state."""
    poison = lambda state, job: (state[0] * jnp.nan, state[1])
    once = lambda state, job: (state[0] + job, jnp.full((), 2))
    state = (jnp.zeros(3), jnp.zeros(3, int))
    value, _ = in_rounds([once, poison], lambda s: s[1], state, jnp.ones(3), 2)
    np.testing.assert_array_equal(value, 1.0)


def test_nothing_to_do():
    state = (jnp.arange(3.0), jnp.full(3, 1))
    never = lambda state, job: (state[0] * jnp.nan, state[1])
    value, _ = in_rounds([never], lambda s: s[1], state, (), 4)
    np.testing.assert_array_equal(value, [0, 1, 2])
