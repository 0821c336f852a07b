"""Several candidates, tracked side by side until one leads.

One scan may fit several places: rooms built alike, both ends of a corridor. The next
scans tell, if each candidate is tracked as if it were the one. All of them take each
step together (`vmap`), and what the map explains of each scan adds up.

The same settles a doubt. A place that was tracked until now, the incumbent, is one of
the candidates, and who wants to take over has to lead it by more: among all places of
a building some explain a strange scan better by chance, and robots are kidnapped
seldom.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from fsmsm_jax.localisation import tracker
from fsmsm_jax.localisation.settle import Candidates
from fsmsm_jax.localisation.tracker import TrackerConfig, TrackerInfo, TrackerState
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid

__all__ = ["Contest", "begun", "deposed", "going_on", "leader", "winner"]


class Contest(NamedTuple):
    """Trackers of all candidates, stacked, and how they fare."""

    states: TrackerState
    totals: Shaped[np.ndarray, "candidates"]
    """Sums over the scans of the mean log-likelihood of a ray."""
    scans: int
    """How many scans that is."""
    incumbent: bool
    """Whether the first of them was tracked before."""


def begun(
    world: OccupancyGrid,
    candidates: Candidates,
    odometry: Float[Array, "3"] | None,
    incumbent: tuple[TrackerState, float] | None = None,
) -> Contest:
    """A tracker for each candidate of one scan, its duplicates left out.

    Args:
        world: the map.
        candidates: as `localise` reports them.
        odometry: what it read at that scan [m, m, rad], if it did.
        incumbent: the tracker until now, and the total that it begins with.
    """
    likelihood = np.asarray(candidates.likelihood)
    distinct = np.flatnonzero(np.isfinite(candidates.scores))
    start = lambda pose: tracker.init(world, pose, None, odometry)
    states, totals = jax.vmap(start)(candidates.poses[distinct]), likelihood[distinct]
    if incumbent is not None:
        state, total = incumbent
        join = lambda one, all: jnp.concatenate([one[None], all])
        states = jax.tree.map(join, state, states)
        totals = np.append(total, totals)
    return Contest(states, totals, 1, incumbent is not None)


_step = jax.jit(jax.vmap(tracker.step, in_axes=(None, 0, None, None, None, None)))


def going_on(
    world: OccupancyGrid,
    contest: Contest,
    scan: Scan,
    odometry: Float[Array, "3"] | None,
    moments: Shaped[np.ndarray, "rays"] | Float[Array, "rays"] | None,
    config: TrackerConfig,
) -> tuple[Contest, TrackerInfo]:
    """One scan on, for all; arguments as of `tracker.step`, infos stacked."""
    states, infos = _step(world, contest.states, scan, odometry, moments, config)
    totals = contest.totals + np.asarray(infos.score)
    return Contest(states, totals, contest.scans + 1, contest.incumbent), infos


def leader(contest: Contest, apart: tuple[float, float]) -> tuple[int, float, bool]:
    """The first of the candidates, its lead, and whether it is where the incumbent is.

    Args:
        contest: at least one candidate.
        apart: places nearer to each other [m, rad] are the same.

    Returns:
        The index of the first; its lead over the best at another place, infinite if
        there is none; whether there is an incumbent, and at the first's place.
    """
    first = int(np.argmax(contest.totals))
    poses = np.asarray(contest.states.pose, float)
    away = poses - poses[first]
    turn = np.abs(np.mod(away[:, 2] + np.pi, 2 * np.pi) - np.pi)
    elsewhere = (np.hypot(away[:, 0], away[:, 1]) > apart[0]) | (turn > apart[1])
    rivals = contest.totals[elsewhere]
    lead = float(contest.totals[first] - np.max(rivals, initial=-np.inf))
    return first, lead, contest.incumbent and not elsewhere[0]


def winner(contest: Contest, index: int) -> TrackerState:
    """The tracker of one candidate, no longer doubted."""
    state = jax.tree.map(lambda a: a[index], contest.states)
    return state._replace(doubt=jnp.zeros_like(state.doubt))


def deposed(contest: Contest) -> Contest:
    """The contest without its incumbent."""
    states = jax.tree.map(lambda a: a[1:], contest.states)
    return Contest(states, contest.totals[1:], contest.scans, False)
