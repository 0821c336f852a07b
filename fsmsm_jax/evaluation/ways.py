"""A way through a map that a robot could take.

The shortest way scrapes along walls. Here a metre near a wall costs as much as several
in the open, so the cheapest way keeps to the middle where there is room. It is found on
a lattice of the free space, whose eight directions make it jagged, and then pulled
straight: corners go where the straight line costs no more.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped
from scipy.sparse import coo_matrix, csgraph

from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["plan"]

_NEAR_A_WALL = 10.0  # a metre along a wall counts as this many and one
_NODES_AROUND = 32  # of the lattice, where a way may begin or end


def plan(
    world: OccupancyGrid | PolygonMap,
    start_xy: Shaped[np.ndarray, "2"] | tuple[float, float],
    goal_xy: Shaped[np.ndarray, "2"] | tuple[float, float],
    clearance: float = 0.5,
) -> Float[np.ndarray, "points 2"]:
    """A short way between two places that keeps off the walls.

    Dijkstra's algorithm on a lattice spaced by a quarter of the clearance, then as
    straight as it can be pulled at no greater cost.

    Args:
        world: the map; unknown space is not driven through.
        start_xy: where the way begins, in the map frame [m].
        goal_xy: where it ends.
        clearance: distance to the walls that is kept where there is room [m]; half of
            it is kept everywhere.

    Returns:
        Corners of the way in the map frame [m], the start first, the goal last.

    Raises:
        ValueError: the clearance is not positive, start or goal are not in free space
            half the clearance from all walls, or no way leads from one to the other.
    """
    if not (math.isfinite(clearance) and clearance > 0):
        raise ValueError(f"clearance must be a positive length [m], got {clearance}")
    lattice, allowed = lattice_over(world, clearance / 4, 0.0)
    positions = lattice.to_map(*jnp.indices(allowed.shape))
    nodes = np.asarray(positions, float)
    dear = np.asarray(_dearness(world, positions, clearance))
    dear = np.where(allowed, dear, np.inf)
    graph = _graph(dear, clearance / 4)
    points = nodes.reshape(-1, 2).astype(float)
    ends = []
    for name, xy in (("start", start_xy), ("goal", goal_xy)):
        xy = np.asarray(xy, float)
        near = np.argsort(np.linalg.norm(points - xy, axis=1))[:_NODES_AROUND]
        near = near[np.isfinite(dear.flat[near])]
        if world.contains(jnp.asarray(xy, float)) and near.size:
            there = np.broadcast_to(xy, points[near].shape)
            cost = _costs(world, there, points[near], clearance, _NODES_AROUND)
            ends.append(int(near[np.argmin(cost)]))
            if np.isfinite(cost.min()):
                continue
        raise ValueError(
            f"the {name} {tuple(map(float, xy))} is not in open space, "
            f"{clearance / 2} m from all walls; choose another or less clearance"
        )
    _, before = csgraph.dijkstra(graph, indices=ends[0], return_predecessors=True)
    chain = [ends[1]]
    while chain[-1] != ends[0]:
        chain.append(int(before[chain[-1]]))
        if chain[-1] < 0:
            raise ValueError(
                f"no way leads from {tuple(map(float, start_xy))} to "
                f"{tuple(map(float, goal_xy))} {clearance / 2} m from all walls"
            )
    way = points[chain[::-1]]
    way = np.concatenate(
        [[np.asarray(start_xy, float)], way, [np.asarray(goal_xy, float)]]
    )
    return _pulled_straight(world, way, clearance)


@jax.jit
def _dearness(world, points, clearance):
    """What a metre costs at these points: from 1 in the open to inf at a wall."""
    near = world.distance_at(points) / clearance
    shut = (near < 0.5) | world.unknown_at(points)
    return jnp.where(shut, jnp.inf, 1 + _NEAR_A_WALL * jnp.clip(1 - near, 0, 1))


def _costs(world, a, b, clearance, samples):
    """Of straight lines from (lines, 2) to (lines, 2) points."""
    share = (np.arange(samples) + 0.5) / samples
    points = a[:, None] + (b - a)[:, None] * share[None, :, None]
    dear = np.asarray(_dearness(world, jnp.asarray(points, float), clearance))
    length = np.linalg.norm(b - a, axis=1)
    return np.where(length > 0, np.maximum(length, 1e-12) * dear.mean(axis=1), 0.0)


def _graph(dear, spacing):
    """Edges to the eight neighbours; half a clearance off, none crosses a wall."""
    rows, columns = dear.shape
    index = np.arange(dear.size).reshape(dear.shape)
    edges = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.s_[: rows - down, max(0, -right) : columns - max(0, right)]
        there = np.s_[down:, max(0, right) : columns + min(0, right)]
        cost = spacing * math.hypot(down, right) * (dear[here] + dear[there]) / 2
        open_ = np.isfinite(cost)
        edges.append((cost[open_], index[here][open_], index[there][open_]))
    cost, a, b = (np.concatenate(part) for part in zip(*edges, strict=True))
    one_way = coo_matrix((cost, (a, b)), (dear.size, dear.size)).tocsr()
    return one_way + one_way.T


def _pulled_straight(world, way, clearance):
    """Leave out corners where the straight line costs no more than the way."""
    longest = np.linalg.norm(np.ptp(way, axis=0))
    samples = math.ceil(10 * longest / clearance) + 1
    legs = _costs(world, way[:-1], way[1:], clearance, samples)
    along = np.append(0.0, np.cumsum(legs))
    kept, last = [0], len(way) - 1
    while kept[-1] < last:
        here = kept[-1]
        here_again = np.broadcast_to(way[here], way.shape)
        straight = _costs(world, here_again, way, clearance, samples)
        no_dearer = straight <= (along - along[here]) * (1 + 1e-4)
        kept.append(max(here + 1, int(np.flatnonzero(no_dearer)[-1])))
    return way[kept]
