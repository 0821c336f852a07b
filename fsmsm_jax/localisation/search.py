"""Where am I? One scan, the whole map, no prior.

`localise` goes from everything to one in five steps, each a batch:

1. **rank** every lattice position at every heading by end points (`correlative`);
2. **turn** the best to the heading that the atlas's panoramas ask for, by one masked
   circular correlation each, and rank again with its similarity;
3. **descend** each survivor onto the walls by its end points (`alignment.fit`);
4. **judge** each by what the map explains of each ray (`judge`), drop near
   duplicates, and polish the best few by their ranges, on the exact derivative;
5. **report** pose, covariance, CAER per ray, the runners-up, and whether the best
   is so much better than any other place that it can be trusted.

The number of candidates falls at each step and the rays per candidate grow. All
shapes are fixed, so one compilation serves every scan of a sensor.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fit import descend_end_points, fit_ranges, polish_ranges
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.localisation.atlas import ScanAtlas, range_phases
from fsmsm_jax.localisation.correlative import rank_poses
from fsmsm_jax.localisation.judge import Evidence, explain, trust
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.panorama import panorama

__all__ = ["Candidates", "Localisation", "SearchConfig", "localise", "localise_batch"]

_TOGETHER = 4  # scans of a batch in step: the quickest of 1, 2, 4 and 8 on two cores
_FEWEST_ECHOES = 20  # fewer end points fit somewhere in any building


class SearchConfig(eqx.Module):
    """How many candidates survive each step, and how many rays judge them."""

    headings: int = eqx.field(static=True, default=90)
    """Headings of the exhaustive search, a multiple of 6."""
    ranked: int = eqx.field(static=True, default=1024)
    """Lattice poses that the panoramas turn and rank again."""
    descended: int = eqx.field(static=True, default=144)
    """Candidates that descend on their end points."""
    polished: int = eqx.field(static=True, default=32)
    """Distinct candidates polished by their ranges."""
    reported: int = eqx.field(static=True, default=8)
    """Distinct candidates in the answer."""
    search_rays: int = eqx.field(static=True, default=180)
    """Rays of the exhaustive search and of the polish."""
    descent_rays: int = eqx.field(static=True, default=90)
    """Rays of the descent."""

    def __check_init__(self):
        """Refuse what the search cannot work with."""
        if self.headings < 6 or self.headings % 6:
            raise ValueError(f"headings must be a multiple of 6, got {self.headings}")
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
    return _localise(atlas, scan, config)


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
    return _localise_batch(atlas, scans, config)


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
    near = np.asarray(scan.echo) & (np.asarray(scan.ranges) < atlas.config.reach)
    echoes = near.sum(axis=-1)
    if np.min(echoes) < _FEWEST_ECHOES:
        raise ValueError(
            f"{np.min(echoes)} of {near.shape[-1]} rays met something within "
            f"{atlas.config.reach} m; at least {_FEWEST_ECHOES} are needed to tell one "
            "place from another. Check range_max and units, or move to where there are "
            "walls in sight"
        )


@jax.jit
def _localise(atlas: ScanAtlas, scan: Scan, config: SearchConfig) -> Localisation:
    world = atlas.world
    ranking_scan = scan.thin(config.search_rays)
    descent_scan = scan.thin(config.descent_rays)

    poses, row, score = rank_poses(atlas, ranking_scan, config.headings, config.ranked)
    poses, similarity = _turn(atlas, scan, poses, row)
    count = min(config.descended, len(poses))
    best = jax.lax.top_k(score + 0.5 * similarity, count)[1]

    scales = jnp.array([0.5, 0.4, 0.3, 0.25, 0.2, 0.2])
    descend = lambda pose: descend_end_points(world, descent_scan, pose, scales)
    poses = jax.vmap(descend)(poses[best])
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


@jax.jit
def _localise_batch(atlas, scans, config):
    one = lambda scan: _localise(atlas, scan, config)
    return jax.lax.map(one, scans, batch_size=_TOGETHER)


def _turn(atlas, scan, poses, row):
    """Headings by the DFT: where the real panorama correlates best, near each pose.

    q[k] = Re Σ_n m_n conj(z_n) v_{n+k}, z and v the range phases of the real and the
    map's panorama, m the mask: at heading θ = 2πk/N the two scans are alike.
    """
    rays = atlas.config.rays
    real = panorama(scan, rays)
    phases = jnp.where(real.valid, range_phases(real.ranges), 0.0)
    spectrum = jnp.conj(jnp.fft.fft(phases))[None] * atlas.panoramas[row]
    q = jnp.fft.ifft(spectrum).real / jnp.maximum(jnp.sum(real.valid), 1)
    step = 2 * jnp.pi / rays
    window = jnp.round(poses[:, 2] / step).astype(int)[:, None]
    window = window + jnp.arange(-2, 3)[None]
    near = jnp.take_along_axis(q, window % rays, axis=1)
    best = jnp.argmax(near, axis=1, keepdims=True)
    theta = jnp.take_along_axis(window, best, axis=1)[:, 0] * step
    turned = poses.at[:, 2].set(geometry.wrap(theta))
    return turned, jnp.take_along_axis(near, best, axis=1)[:, 0]


def _judge(world, scan, poses, thickness=None) -> Evidence:
    thickness = jnp.zeros(len(poses)) if thickness is None else thickness
    return jax.vmap(lambda *place: explain(world, scan, *place))(poses, thickness)


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
