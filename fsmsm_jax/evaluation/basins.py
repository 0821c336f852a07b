"""From how far off does a matcher still find home? Its basin of convergence.

Descent is only as good as its start. So a matcher is asked the same cases from worse
and worse initial poses: so many metres away in a random direction, and turned by so
many radians to a random side. The share of cases that come home, as a table of
distance by turn, is the basin. Directions are drawn once a case and serve all cells
and, with the same key, all matchers: basins differ by what was asked, not by luck.

A start inside a wall would ask something else. Where the first direction leads into
one, others are tried; a case none of whose directions stays in the open is left out of
that cell.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.metrics import success
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Basin", "basin"]

_DIRECTIONS = 16  # tried for a start in the open


class Basin(NamedTuple):
    """Which initial errors a matcher recovers from."""

    distances: Float[np.ndarray, "distances"]
    """Initial distances to the true position [m]."""
    turns: Float[np.ndarray, "turns"]
    """Initial errors of the heading [rad], to either side."""
    share: Float[np.ndarray, "distances turns"]
    """Share of the cases that came home; NaN where none could be asked."""
    asked: Float[np.ndarray, "distances"]
    """Share of the cases that had a start in the open at this distance."""


def basin(
    key: PRNGKeyArray,
    match: Callable[[PolygonMap | OccupancyGrid, Scan, Array], Array],
    worlds: OccupancyGrid | PolygonMap,
    scans: Scan,
    true: Float[Array, "cases 3"],
    distances: Sequence[float],
    turns: Sequence[float],
    position: float = 0.05,
    orientation: float = math.radians(1.0),
) -> Basin:
    """Share of the cases that a matcher brings home, by initial error.

    Args:
        key: of directions and sides; the same key asks the same questions.
        match: `(worlds, scans, initial) -> poses`, all along the same first axis. For a
            matcher of one case, its `vmap`; jitted, or it is slow.
        worlds: one world a case, stacked along the first axis.
        scans: one scan a case, stacked.
        true: where they were taken [m, m, rad].
        distances: initial distances [m], one row each.
        turns: initial errors of the heading [rad], one column each.
        position: home is nearer than this to the true position [m] …
        orientation: … and than this to the true heading [rad].

    Returns:
        The table; a distance of 0 asks for the heading alone.
    """
    key_direction, key_side = jax.random.split(key)
    count = len(true)
    directions = jax.random.uniform(
        key_direction, (count, _DIRECTIONS), true.dtype, -jnp.pi, jnp.pi
    )
    side = jax.random.rademacher(key_side, (count,), true.dtype)
    share = np.full((len(distances), len(turns)), np.nan)
    asked = np.zeros(len(distances))
    for row, distance in enumerate(distances):
        at, free = _starts(worlds, true, directions, jnp.asarray(distance, true.dtype))
        asked[row] = np.mean(free)
        for column, turn in enumerate(turns):
            heading = geometry.wrap(true[:, 2] + turn * side)
            initial = jnp.concatenate([at, heading[:, None]], axis=1)
            home = success(match(worlds, scans, initial), true, position, orientation)
            if np.any(free):
                share[row, column] = np.mean(np.asarray(home)[np.asarray(free)])
    return Basin(np.array(distances, float), np.array(turns, float), share, asked)


@jax.jit
def _starts(
    worlds, true, directions, distance
) -> tuple[Float[Array, "cases 2"], Bool[Array, "cases"]]:
    """A position that far off in each world, and whether it is in the open."""

    def one(world, pose, directions):
        away = jnp.stack([jnp.cos(directions), jnp.sin(directions)], axis=-1)
        tries = pose[None, :2] + distance * away
        inside = world.contains(tries)
        return tries[jnp.argmax(inside)], jnp.any(inside)

    return jax.vmap(one)(worlds, true, directions)
