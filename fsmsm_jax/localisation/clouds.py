"""How a cloud of particles begins: about a pose, anywhere, or where the atlas says.

Spread evenly over a building, particles must be so many that some stand right by
chance, within decimetres and degrees: tens of thousands a floor. The atlas answers the
same question by looking. Its candidates for the first scan, weighed and blurred, are
a cloud that has converged before it moved; and where rooms are alike it keeps all of
them, until the robot has driven past a difference.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax import geometry
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.feedback import gaussian_cloud
from fsmsm_jax.localisation.particles import ParticleConfig, Particles
from fsmsm_jax.localisation.search import localise
from fsmsm_jax.localisation.settle import SearchConfig
from fsmsm_jax.resampling import systematic
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["init_at", "init_from_atlas", "init_uniform"]

_TRIES = 32  # points thrown into a polygon map's box until one is inside
_CANDIDATES = SearchConfig(reported=32)
_WITNESSES = 20.0  # rays of a scan that count as independent when places are compared
_JITTER = (0.05, 0.03)  # [m, rad] standard deviations of particles about a candidate


def init_at(
    key: PRNGKeyArray,
    pose: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    config: ParticleConfig = ParticleConfig(),
) -> Particles:
    """A cloud about a pose.

    Args:
        key: of the draw.
        pose: of the lidar in the map [m, m, rad].
        covariance: of that [m, m, rad]²; amcl's is diag(0.25, 0.25, 0.0685).
        config: settings; there are as many particles as there is room for.
    """
    return _evenly(gaussian_cloud(key, pose, covariance, config.kld.most))


def init_uniform(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    config: ParticleConfig = ParticleConfig(),
) -> Particles:
    """A cloud all over the free space of a map, in all directions.

    Args:
        key: of the draw.
        world: the map; a grid must have a free cell (`load_map` sees to that).
        config: settings; there are as many particles as there is room for.
    """
    key_place, key_within, key_yaw = jax.random.split(key, 3)
    count = config.kld.most
    if isinstance(world, OccupancyGrid):
        heap = jnp.cumsum(world.free.reshape(-1))
        pick = jax.random.randint(key_place, (count,), 0, heap[-1])
        row, column = jnp.divmod(
            jnp.searchsorted(heap, pick, side="right"), world.cells.shape[1]
        )
        within = jax.random.uniform(key_within, (count, 2), world.distance.dtype)
        xy = world.to_map(jnp.stack([column, row], axis=1) + within)
    else:
        ends = jnp.concatenate([world.start, world.end])
        low, high = ends.min(axis=0), ends.max(axis=0)
        shape = (count, _TRIES, 2)
        thrown = jax.random.uniform(key_place, shape, ends.dtype)
        thrown = low[None, None] + thrown * (high - low)[None, None]
        inside = jnp.argmax(world.contains(thrown), axis=1)
        xy = jnp.take_along_axis(thrown, inside[:, None, None], axis=1)[:, 0]
    yaw = jax.random.uniform(key_yaw, (count, 1), xy.dtype, -jnp.pi, jnp.pi)
    return _evenly(jnp.concatenate([xy, yaw], axis=1))


def init_from_atlas(
    key: PRNGKeyArray,
    atlas: ScanAtlas,
    scan: Scan,
    config: ParticleConfig = ParticleConfig(),
) -> Particles:
    """A cloud about the places that the first scan may come from.

    `localise` names up to 32 distinct places; each gets particles by its likelihood, as
    if 20 rays of the scan were independent. So room for some hundred particles may do
    where an even spread wants many more.

    Args:
        key: of the draw.
        atlas: the map's.
        scan: the first scan.
        config: settings; there are as many particles as there is room for.

    Raises:
        ValueError: the scan has too few echoes to tell places apart (`localise`).
    """
    found = localise(atlas, scan, _CANDIDATES).candidates
    weights = jnp.exp(_WITNESSES * (found.scores - found.scores[0]))
    key_draw, key_jitter = jax.random.split(key)
    index = systematic(key_draw, weights, config.kld.most)
    sigmas = jnp.asarray([_JITTER[0], *_JITTER], found.poses.dtype)
    about = gaussian_cloud(key_jitter, jnp.zeros(3), jnp.diag(sigmas**2), len(index))
    poses = found.poses[index] + about
    return _evenly(poses.at[:, 2].set(geometry.wrap(poses[:, 2])))


def _evenly(poses):
    """A full population, all particles of the same weight."""
    room = len(poses)
    return Particles(
        poses=poses,
        log_weights=jnp.full(room, -np.log(room), poses.dtype),
        living=jnp.asarray(room, int),
        odometry=jnp.full(3, jnp.nan, poses.dtype),
        updates=jnp.asarray(0, int),
    )
