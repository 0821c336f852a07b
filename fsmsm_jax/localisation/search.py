"""Where am I? One scan, the whole map, no prior.

`localise` goes from everything to one in five steps, each a batch:

1. **rule out** the lattice positions whose ranges do not fit, turned any way
   (`shells`), and **rank** what is left, at every heading, by end points
   (`correlative`);
2. **descend** from the best thousands onto the walls with few rays, and from what fits
   best there with more (`alignment.fit`);
3. **judge** each by what the map explains of each ray (`judge`), and drop near
   duplicates;
4. **polish** the best by their ranges, on the exact derivative, and judge again;
5. **report** pose, covariance, CAER per ray, the runners-up, and whether the best
   is so much better than any other place that it can be trusted.

The lattice is coarse, and the end points' basin is wide: half a spacing and half a step
of heading are mended by three Gauss-Newton steps, which cost less than a finer lattice
and lose less. The number of candidates falls at each step and the rays per candidate
grow. All shapes are fixed, so one compilation serves every scan of a sensor.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.blocks import cut, room_for
from fsmsm_jax.alignment.fit import descend_end_points, fit_ranges, polish_ranges
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.correlative import rank_poses
from fsmsm_jax.localisation.judge import Evidence, explain, on_walls, trust
from fsmsm_jax.localisation.sharding import rank_on_mesh
from fsmsm_jax.localisation.tiles import mesh_of
from fsmsm_jax.sensing.buckets import filled, padded
from fsmsm_jax.sensing.lidar import Scan

__all__ = [
    "Candidates",
    "Localisation",
    "SearchConfig",
    "check_echoes",
    "localise",
    "localise_batch",
    "query",
    "query_batch",
]

_TOGETHER = 4  # scans of a batch in step: the quickest of 1, 2, 4 and 8 on two cores
_OFF_WALLS = 0.5  # [nats a ray]: quarter to twice of it do as well on all recordings
_FEWEST_ECHOES = 20  # fewer end points fit somewhere in any building


class SearchConfig(eqx.Module):
    """How many candidates survive each step, and how many rays judge them."""

    headings: int = eqx.field(static=True, default=60)
    """Headings of the exhaustive search, an even number."""
    ranked: int = eqx.field(static=True, default=4096)
    """Lattice poses that descend with few rays."""
    descended: int = eqx.field(static=True, default=384)
    """Candidates that descend with more."""
    polished: int = eqx.field(static=True, default=96)
    """Distinct candidates polished by their ranges."""
    reported: int = eqx.field(static=True, default=16)
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
    """Mean log-likelihood of a ray; higher is better, −inf marks a duplicate."""
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


def localise(
    atlas: ScanAtlas, scan: Scan, config: SearchConfig = SearchConfig()
) -> Localisation:
    """Where in the map was this scan taken?

    Args:
        atlas: the map's atlas.
        scan: one real scan, of any field of view and number of rays.
        config: how hard to look.

    Returns:
        The best pose and what to think of it; arrays on the device.

    Raises:
        ValueError: `atlas` is no ScanAtlas, or the scan has fewer than 20 echoes
            within the atlas's reach, so that it would fit anywhere.

    Example:
        >>> import fsmsm_jax as fj
        >>> world = fj.buildings.office(seed=0)
        >>> atlas = fj.build_atlas(world)
        >>> fj.localise(atlas, scan).pose  # doctest: +SKIP
    """
    _check(atlas, scan, batched=False)
    scan = padded(scan)
    if mesh_of(atlas.tiles) is None:
        return query(atlas, scan, config)
    return _settle_jit(atlas.world, scan, _ranked_on_mesh(atlas, scan, config), config)


def localise_batch(
    atlas: ScanAtlas, scans: Scan, config: SearchConfig = SearchConfig()
) -> Localisation:
    """`localise` for many scans of one sensor in one call.

    Args:
        atlas: the map's atlas.
        scans: scans stacked along a leading axis
            (`jax.tree.map(lambda *a: jnp.stack(a), *list_of_scans)`).
        config: how hard to look.

    Returns:
        A `Localisation` whose arrays have the same leading axis.

    Raises:
        ValueError: as `localise`, for any of the scans.
    """
    _check(atlas, scans, batched=True)
    # Few shapes: rays that say nothing, and the last scan again, fill the batch up.
    count = len(scans.ranges)
    scans = filled(padded(scans), room_for(count))
    if mesh_of(atlas.tiles) is None:
        return cut(query_batch(atlas, scans, config), count)
    poses = _ranked_on_mesh(atlas, scans, config)
    return cut(_settle_batch(atlas.world, scans, poses, config), count)


def _check(atlas, scan, *, batched):
    if not isinstance(atlas, ScanAtlas):
        raise ValueError(
            f"expected a ScanAtlas, got {type(atlas).__name__}; "
            "make one with build_atlas(world)"
        )
    axes, wanted = np.ndim(scan.ranges), 2 if batched else 1
    if axes != wanted:
        raise ValueError(
            f"expected {'(scans, rays)' if batched else '(rays,)'} ranges, got shape "
            f"{np.shape(scan.ranges)}; localise takes one scan, localise_batch many"
        )
    check_echoes(scan, atlas.config.reach)


def check_echoes(scan: Scan, reach: float) -> None:
    """Refuse a scan, or a batch with one, that would fit anywhere.

    Raises:
        ValueError: it has fewer than 20 echoes within the reach [m] of an atlas.
    """
    near = np.asarray(scan.echo) & (np.asarray(scan.ranges) < reach)
    echoes = near.sum(axis=-1)
    if np.min(echoes) < _FEWEST_ECHOES:
        raise ValueError(
            f"{np.min(echoes)} of {near.shape[-1]} rays met something within "
            f"{reach} m; at least {_FEWEST_ECHOES} are needed to tell one "
            "place from another. Check range_max and units, or move to where there are "
            "walls in sight"
        )


@jax.jit
def query(atlas: ScanAtlas, scan: Scan, config: SearchConfig) -> Localisation:
    """`localise` without a look at what it is given, for an atlas on one device."""
    return _settle(atlas.world, scan, _ranked(atlas, scan, config), config)


@jax.jit
def query_batch(atlas: ScanAtlas, scans: Scan, config: SearchConfig) -> Localisation:
    """`localise_batch` without a look at what it is given."""
    ranked = jax.lax.map(lambda scan: _ranked(atlas, scan, config), scans)
    return _settle_each(atlas.world, scans, ranked, config)


def _ranked(atlas, scan, config):
    """Lattice poses worth a descent."""
    thin = scan.thin(config.search_rays)
    return rank_poses(atlas, thin, config.headings, config.ranked).poses


def _ranked_on_mesh(atlas, scan, config):
    """The same, of one scan or a batch, by all devices of the atlas."""
    sizes = config.search_rays, config.headings, config.ranked
    return rank_on_mesh(atlas, scan, *sizes)


def _settle_each(world, scans, poses, config):
    settle = lambda one: _settle(world, one[0], one[1], config)
    return jax.lax.map(settle, (scans, poses), batch_size=_TOGETHER)


def _settle(world, scan, poses, config) -> Localisation:
    """From lattice poses to an answer."""
    few = scan.thin(config.descent_rays // 2)
    ranking_scan = scan.thin(config.search_rays)
    descent_scan = scan.thin(config.descent_rays)

    scales = jnp.array([0.8, 0.5, 0.3])
    descend = lambda pose: descend_end_points(world, few, pose, scales)
    # Barriers keep XLA from computing poses and scores again for each of their readers.
    poses = jax.lax.optimization_barrier(jax.vmap(descend)(poses))
    score = jax.vmap(lambda pose: on_walls(world, few, pose))(poses)
    score = jax.lax.optimization_barrier(score)
    poses = poses[jax.lax.top_k(score, min(config.descended, len(poses)))[1]]

    scales = jnp.array([0.3, 0.25, 0.2, 0.2])
    descend = lambda pose: descend_end_points(world, descent_scan, pose, scales)
    poses = jax.vmap(descend)(poses)
    score = _judge(world, descent_scan, poses).score
    poses = poses[_distinct(poses, score, config.polished, 0.25, 0.15)[0]]

    scales = jnp.array([0.4, 0.25, 0.2])
    polish = lambda pose: polish_ranges(world, ranking_scan, pose, scales)
    poses, thickness = jax.vmap(polish)(poses)
    score = _judge(world, ranking_scan, poses, thickness).score
    poses = poses[_distinct(poses, score, config.reported, 0.3, 0.25)[0]]

    scales = jnp.array([0.2, 0.15, 0.1])  # sharp: what is there decides
    polish = lambda pose: polish_ranges(world, scan, pose, scales)
    poses, thickness = jax.vmap(polish)(poses)
    evidence = _judge(world, scan, poses, thickness)
    order, score = _distinct(poses, evidence.score, config.reported, 0.3, 0.25)
    poses, evidence = jax.tree.map(lambda a: a[order], (poses, evidence))
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
        candidates=Candidates(poses, score, evidence.caer_per_ray),
    )


_settle_jit, _settle_batch = jax.jit(_settle), jax.jit(_settle_each)


def _judge(world, scan, poses, thickness=None) -> Evidence:
    """`explain`, whose score loses where rays end off walls or lead through some.

    In equal corridors a grazing ray's range says little and its end point still much.
    """

    def one(pose, thickness):
        evidence = explain(world, scan, pose, thickness)
        off = 1 - on_walls(world, scan, pose)
        return evidence._replace(score=evidence.score - _OFF_WALLS * off)

    thickness = jnp.zeros(len(poses)) if thickness is None else thickness
    return jax.vmap(one)(poses, thickness)


def _distinct(poses, score, count, distance, angle):
    """Indices of the best poses, best first, and their scores.

    Those closer to a better one than `distance` [m] and `angle` [rad] sink with
    score −inf.
    """
    order = jnp.argsort(-score)
    apart = poses[order][:, None] - poses[order][None]
    close = (jnp.linalg.norm(apart[..., :2], axis=-1) < distance) & (
        jnp.abs(geometry.wrap(apart[..., 2])) < angle
    )
    duplicate = jnp.any(close & jnp.tri(len(poses), k=-1, dtype=bool), axis=1)
    score = jnp.where(duplicate, -jnp.inf, score[order])
    kept = jnp.argsort(-score)[:count]
    return order[kept], score[kept]
