"""From some thousand places to an answer: descend, judge, polish, drop duplicates.

The lattice of the search is coarse, and its poses stand up to half a spacing and half a
step of heading beside the truth. They all descend onto the walls with few rays, the
better half of them farther; what fits best there descends again with more; distinct
places are polished by their ranges on the exact derivative, the best of them by both
witnesses in turn. At each step fewer candidates are left and more rays judge them. All
counts are fixed (`SearchConfig`), so one compilation serves every scan of a sensor.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fit import descend_end_points, fit_ranges, polish_ranges
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.localisation.judge import (
    ON_THE_WAY,
    Evidence,
    explain,
    on_walls,
    trust,
)
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["Candidates", "Localisation", "SearchConfig", "settle"]

_ASTRAY = 0.1  # [nats a ray] that a polish may cost; those that stray cost twice that
_FIRST = 16  # places that all rays polish again; the others stay as fewer left them
# [nats a ray]. Half of it found 11 of 970 scans fewer in long corridors, 4 of 1 242 and
# one of 208 more in offices.
_OFF_WALLS = 1.0


class SearchConfig(eqx.Module):
    """How many candidates survive each step, and how many rays judge them."""

    headings: int = eqx.field(static=True, default=60)
    """Headings of the exhaustive search, an even number."""
    ranked: int = eqx.field(static=True, default=3072)
    """Lattice poses that descend with few rays."""
    descended: int = eqx.field(static=True, default=384)
    """Candidates that descend with more."""
    polished: int = eqx.field(static=True, default=96)
    """Distinct candidates polished by their ranges."""
    reported: int = eqx.field(static=True, default=32)
    """Distinct candidates in the answer."""
    search_rays: int = eqx.field(static=True, default=180)
    """Rays of the exhaustive search and of the polish."""
    descent_rays: int = eqx.field(static=True, default=90)
    """Rays of the second descent, twice as many as of the first."""

    def __check_init__(self):
        """Refuse what the search cannot work with."""
        if self.headings < 6 or self.headings % 2:
            raise ValueError(
                f"headings must be an even number from 6 on, got {self.headings}"
            )
        if not 2 <= self.reported <= self.polished <= self.descended <= self.ranked:
            raise ValueError(
                "candidates dwindle: expected 2 ≤ reported ≤ polished ≤ descended "
                f"≤ ranked, got {self.reported}, {self.polished}, {self.descended}, "
                f"{self.ranked}"
            )
        if min(self.search_rays, self.descent_rays) < 8:
            raise ValueError("search_rays and descent_rays must be at least 8")


class Candidates(NamedTuple):
    """Distinct places that the scan may come from, best first."""

    poses: Float[Array, "candidates 3"]
    """Poses of the lidar in the map [m, m, rad]."""
    scores: Float[Array, "candidates"]
    """Mean log-likelihood of a ray, less what rays lose that end off walls; higher is
    better, −inf marks a duplicate. The first few are by all rays, the others by
    `search_rays` of them."""
    likelihood: Float[Array, "candidates"]
    """Mean log-likelihood of a ray (`judge.explain`), which the tracker goes by."""
    caer_per_ray: Float[Array, "candidates"]
    """Mean |real − virtual range| where sensor and map both see something [m]."""


class Localisation(NamedTuple):
    """What one scan says about where the lidar is."""

    pose: Float[Array, "3"]
    """Best pose of the lidar in the map [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Its covariance, from the Fisher information of the ranges [m, m, rad]²."""
    caer_per_ray: Float[Array, ""]
    """Mean |real − virtual range| where sensor and map both see something [m]."""
    explained: Float[Array, ""]
    """Share of the valid rays that the map explains."""
    confident: Bool[Array, ""]
    """Whether the pose can be trusted: explained well, and no rival comes near."""
    candidates: Candidates
    """The best places; index 0 is `pose`, index 1 the runner-up."""


def settle(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    poses: Float[Array, "ranked 3"],
    config: SearchConfig,
) -> Localisation:
    """From lattice poses to an answer.

    Args:
        world: the map.
        scan: the real scan.
        poses: where to begin [m, m, rad]; as many as there are, up to `ranked`.
        config: how many survive each step.
    """
    ranking_scan = scan.thin(config.search_rays)
    descent_scan = scan.thin(config.descent_rays)

    # Two steps show which half is hopeless; the others take two more.
    few = scan.thin(config.descent_rays // 2)
    promising = max(config.descended, len(poses) // 2)
    poses = _descend(world, few, poses, [0.8, 0.5], promising, ON_THE_WAY[1:2])
    poses = _descend(world, few, poses, [0.4, 0.3], config.descended, ON_THE_WAY)

    scales = jnp.array([0.3, 0.25, 0.2, 0.2])
    descend = lambda pose: descend_end_points(world, descent_scan, pose, scales)
    poses = jax.vmap(descend)(poses)
    found = poses, *_judge(world, descent_scan, poses)
    found = _distinct(found, config.polished, 0.25, 0.15)

    found = _polish(world, ranking_scan, found, [0.4, 0.2])
    found = _distinct(found, config.reported, 0.3, 0.25)

    first = jax.tree.map(lambda a: a[:_FIRST], found)
    first = _polish(world, scan, first, [0.2, 0.15, 0.1])  # sharp: all is there
    first = _reconsider(world, scan, first, [0.2, 0.15, 0.1])
    join = lambda new, old: jnp.concatenate([new, old[_FIRST:]])
    found = jax.tree.map(join, first, found)
    poses, score, evidence = _distinct(found, config.reported, 0.3, 0.25)
    pose, thick = fit_ranges(world, scan, poses[0], 4, 0.1)  # all good rays count
    poses = poses.at[0].set(pose)
    spread = covariance(world, scan, pose, thick)
    best = jax.tree.map(lambda a: a[0], evidence)
    return Localisation(
        pose=pose,
        covariance=spread,
        caer_per_ray=best.caer_per_ray,
        explained=best.explained,
        confident=trust(score, best, spread),
        candidates=Candidates(poses, score, evidence.score, evidence.caer_per_ray),
    )


def _descend(world, scan, poses, scales, count, probes):
    """Down onto the walls; those that are then on them best, by `on_walls`."""
    one = lambda pose: descend_end_points(world, scan, pose, jnp.array(scales))
    # Barriers keep XLA from computing poses and scores again for each of their readers.
    poses = jax.lax.optimization_barrier(jax.vmap(one)(poses))
    score = jax.vmap(lambda pose: on_walls(world, scan, pose, probes))(poses)
    score = jax.lax.optimization_barrier(score)
    return poses[jax.lax.top_k(score, min(count, len(poses)))[1]]


def _polish(world, scan, found, scales) -> tuple[Array, Array, Evidence]:
    """Poses by their ranges, judged anew; as they were found if that went astray.

    Rays that graze walls pull many a good pose away. A little worse is no sign of it.
    """
    poses, score, _ = found
    polish = lambda pose: polish_ranges(world, scan, pose, jnp.array(scales))
    polished, thickness = jax.vmap(polish)(poses)
    after = polished, *_judge(world, scan, polished, thickness)
    return _choose(after[1] > score - _ASTRAY, after, found)


def _reconsider(world, scan, found, scales) -> tuple[Array, Array, Evidence]:
    """Each place by its end points, and from there by its ranges: the best of all.

    Either witness stops in valleys of its own, the other leads out of many of them.
    """
    descend = lambda pose: descend_end_points(world, scan, pose, jnp.array(scales))
    poses = jax.vmap(descend)(found[0])
    by_ends = poses, *_judge(world, scan, poses)
    by_ranges = _polish(world, scan, by_ends, scales)
    for other in by_ends, by_ranges:
        found = _choose(other[1] > found[1], other, found)
    return found


def _choose(better, new, old):
    """Item by item of the leading axis, the new one where it is better."""
    return jax.tree.map(
        lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old
    )


def _judge(world, scan, poses, thickness=None) -> tuple[Array, Evidence]:
    """Scores to rank by, and the evidence of `explain`.

    A score is the mean log-likelihood, less what is lost where rays end off walls or
    lead through some: in equal corridors a grazing ray's range says little and its end
    point still much.
    """

    def one(pose, thickness):
        evidence = explain(world, scan, pose, thickness)
        off = 1 - on_walls(world, scan, pose)
        return evidence.score - _OFF_WALLS * off, evidence

    thickness = jnp.zeros(len(poses)) if thickness is None else thickness
    return jax.vmap(one)(poses, thickness)


def _distinct(found, count, distance, angle):
    """The best of poses, scores and evidence, best first.

    Those closer to a better one than `distance` [m] and `angle` [rad] sink with
    score −inf.
    """
    poses, score, evidence = found
    order = jnp.argsort(-score)
    apart = poses[order][:, None] - poses[order][None]
    close = (jnp.linalg.norm(apart[..., :2], axis=-1) < distance) & (
        jnp.abs(geometry.wrap(apart[..., 2])) < angle
    )
    duplicate = jnp.any(close & jnp.tri(len(poses), k=-1, dtype=bool), axis=1)
    score = jnp.where(duplicate, -jnp.inf, score[order])
    kept = jnp.argsort(-score)[:count]
    poses, evidence = jax.tree.map(lambda a: a[order[kept]], (poses, evidence))
    return poses, score[kept], evidence
