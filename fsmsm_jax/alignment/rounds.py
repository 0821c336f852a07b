"""Many jobs of unequal length in one loop, none waiting for the slowest.

`vmap` of a `while_loop` runs every lane until the last one is done, and under `vmap` a
`switch` runs every branch. Here one loop goes over the whole batch instead: each round
looks which stage most jobs wait at, takes up to `block` of them out of the batch, gives
them one step of that stage all together, and puts them back. Only the stage's own work
is done, and lanes stand idle only when fewer than a block are left.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

__all__ = ["in_rounds"]

_S = TypeVar("_S")


def in_rounds(
    stages: Sequence[Callable[..., _S]],
    stage_of: Callable[[_S], Int[Array, "jobs"]],
    state: _S,
    jobs: Any,
    block: int,
) -> _S:
    """Step every job until it has left the last stage.

    Args:
        stages: functions (state, job) -> state of **one** job, one a stage.
        stage_of: reads the stage of each job off the batched state: an index into
            `stages`, or `len(stages)` when the job is done.
        state: pytree with a leading axis of jobs.
        jobs: what each job is about and no step changes; pytree, same leading axis.
        block: how many jobs a round takes; static.

    Returns:
        The state with every job done.

    Example:
        >>> halve = lambda state, job: (state[0] / 2, jnp.where(state[0] > 2, 0, 1))
        >>> start = (jnp.array([3.0, 40.0, 5.0]), jnp.zeros(3, int))
        >>> [x.tolist() for x in in_rounds([halve], lambda s: s[1], start, (), 2)]
        [[0.75, 0.625, 0.625], [1, 1, 1]]

    Note:
        A loop of unknown length: not differentiable in reverse mode. Do not `vmap` it;
        make the batch longer.
    """
    count = jax.tree.leaves(state)[0].shape[0]
    steps = [jax.vmap(stage) for stage in stages]

    def unfinished(state):
        return jnp.any(stage_of(state) < len(steps))

    def one_round(state):
        at = stage_of(state)
        waiting = jnp.sum(at[:, None] == jnp.arange(len(steps))[None, :], axis=0)
        stage = jnp.argmax(waiting)
        taken = jnp.nonzero(at == stage, size=min(block, count), fill_value=count)[0]
        take = partial(jax.tree.map, lambda a: a.at[taken].get(mode="clip"))
        after = jax.lax.switch(stage, steps, take(state), take(jobs))
        return jax.tree.map(
            lambda a, new: a.at[taken].set(new, mode="drop"), state, after
        )

    return jax.lax.while_loop(unfinished, one_round, state)
