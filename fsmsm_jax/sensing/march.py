"""Rays walk through a grid, exactly, in hops over empty space.

A cell whose nearest obstacle is k cells away (chessboard distance) heads a free box of
2k − 1 cells, and a ray goes straight to that box's exit: about five hops finish a ray
indoors. `march` walks many rays at once. Long rays would hold up the others, so after
some hops the unfinished ones are gathered into a short array, which walks on alone; and
under `vmap` all rays become one flat batch, so that this pays.
"""

import functools

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

__all__ = ["march"]

_CHUNK = 1 << 18  # rays marched together: their state fits the last-level cache
_LEAF = 2048  # below this many rays compaction costs more than idle lanes
_HOPS = 10  # hops before the first compaction: nine rays of ten are done by then


@custom_vmap
def march(clearance, x, y, headings, far):
    """Walk flat batches of rays to the first cell that stops them.

    All in cell units, `headings` in the grid's frame. Returns the distance to the
    entry face of the last cell and that cell's column and row (outside the grid if
    the ray left it; distance ≥ far if the ray went too far).
    """
    rays = x.shape[0]
    chunk = min(_CHUNK, rays)
    chunks = -(-rays // chunk)
    padded = [jnp.pad(a, (0, chunks * chunk - rays)) for a in (x, y, headings, far)]

    def one(args):
        return _march_compacting(clearance, *_start(clearance, *args), _HOPS)

    if chunks == 1:
        return one(padded)
    walked = jax.lax.map(one, [a.reshape(chunks, chunk) for a in padded])
    return tuple(a.reshape(-1)[:rays] for a in walked)


@march.def_vmap
def _march_flat(axis_size, in_batched, clearance, *rays):
    """Under `vmap`, more rays of the same kind: flatten, so that no lane idles."""
    spread = [
        a if b else jnp.broadcast_to(a, (axis_size, *a.shape))
        for a, b in zip(rays, in_batched[1:], strict=True)
    ]
    if in_batched[0]:  # many worlds: one after the other
        out = jax.lax.map(lambda args: march(*args), (clearance, *spread))
    else:
        flat = march(clearance, *(a.reshape(-1) for a in spread))
        out = tuple(a.reshape(axis_size, -1) for a in flat)
    return out, (True, True, True)


def _start(clearance, x, y, headings, far):
    """Per-ray constants (x, y, dx, dy, far) and state (t, column, row)."""
    dx, dy = jnp.cos(headings), jnp.sin(headings)
    tiny = jnp.finfo(dx.dtype).tiny ** 0.5  # so that no ray is parallel to an axis
    dx = jnp.where(jnp.abs(dx) < tiny, tiny, dx)
    dy = jnp.where(jnp.abs(dy) < tiny, tiny, dy)
    height, width = clearance.shape
    column = jnp.clip(jnp.floor(x), -1, width - 2).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), -1, height - 2).astype(jnp.int32)
    return (x, y, dx, dy, far), (jnp.zeros_like(x), column, row)


def _free_radius(clearance, column, row):
    """Clearance of the cell; the ring of padding shifts indices by one."""
    index = (row + 1) * clearance.shape[1] + column + 1
    return (
        clearance.reshape(-1).at[index].get(mode="promise_in_bounds").astype(jnp.int32)
    )


def _walking(clearance, ray, state):
    t, column, row = state
    return (_free_radius(clearance, column, row) > 0) & (t < ray[4])


def _hop(clearance, ray, state):
    """One jump to the exit of the free box around the current cell."""
    (x, y, dx, dy, far), (t, column, row) = ray, state
    k = _free_radius(clearance, column, row)
    right, up = dx > 0, dy > 0
    t_column = (jnp.where(right, column + k, column - k + 1) - x) / dx
    t_row = (jnp.where(up, row + k, row - k + 1) - y) / dy
    sideways = t_column < t_row
    t_exit = jnp.minimum(t_column, t_row)
    # The crossed index is set exactly; the other one may not leave the box by rounding.
    near_column = jnp.clip(
        jnp.floor(x + t_exit * dx).astype(jnp.int32), column - k + 1, column + k - 1
    )
    near_row = jnp.clip(
        jnp.floor(y + t_exit * dy).astype(jnp.int32), row - k + 1, row + k - 1
    )
    next_column = jnp.where(
        sideways, jnp.where(right, column + k, column - k), near_column
    )
    next_row = jnp.where(sideways, near_row, jnp.where(up, row + k, row - k))
    go = (k > 0) & (t < far)
    return (
        jnp.where(go, t_exit, t),
        jnp.where(go, next_column, column),
        jnp.where(go, next_row, row),
    )


def _march_compacting(clearance, ray, state, hops):
    """Hop a while, gather the unfinished rays into a short array, recurse on it.

    Long rays would otherwise hold up the whole batch. Gathers are cheap on every
    device and scatters are not, so results come back by a gather as well.
    """
    hop = functools.partial(_hop, clearance, ray)
    rays = ray[0].shape[0]
    if rays <= _LEAF:
        return jax.lax.while_loop(
            lambda state: jnp.any(_walking(clearance, ray, state)),
            lambda state: hop(hop(state)),
            state,
        )
    state = jax.lax.fori_loop(0, hops, lambda _, state: hop(state), state)
    walking = _walking(clearance, ray, state)
    place = jnp.cumsum(walking)
    short = -(-rays // 8)
    index = jnp.nonzero(walking, size=8 * short, fill_value=rays)[0]

    def block(b, walked):
        mine = jax.lax.dynamic_slice(index, (b * short,), (short,))
        *sub_ray, sub_far = (a.at[mine].get(mode="clip") for a in ray)
        sub_far = jnp.where(mine < rays, sub_far, -1.0)  # fillers stand still
        sub_state = tuple(a.at[mine].get(mode="clip") for a in state)
        done = _march_compacting(clearance, (*sub_ray, sub_far), sub_state, 2 * hops)
        return tuple(
            jax.lax.dynamic_update_slice(a, v, (b * short,))
            for a, v in zip(walked, done, strict=True)
        )

    walked = jax.lax.fori_loop(
        0,
        -(-place[-1] // short),
        block,
        tuple(jnp.zeros(8 * short, a.dtype) for a in state),
    )
    return tuple(
        jnp.where(walking, late.at[place - 1].get(mode="clip"), now)
        for late, now in zip(walked, state, strict=True)
    )
