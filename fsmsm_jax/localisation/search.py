"""Where am I? One scan, the whole map, no prior.

`localise` goes from everything to one in five steps, each a batch:

1. **rule out** the lattice positions whose ranges do not fit, turned any way
   (`shells`), and **rank** what is left, at every heading, by end points
   (`correlative`);
2. **descend** from the best thousands onto the walls with few rays, and from what fits
   best there with more (`alignment.fit`);
3. **judge** each by what the map explains of each ray (`judge`), and drop near
   duplicates (2 to 5 are `settle`);
4. **polish** the best by their ranges, on the exact derivative, and judge again;
5. **report** pose, covariance, CAER per ray, the runners-up, and whether the best
   is so much better than any other place that it can be trusted.

The lattice is coarse, and the end points' basin is wide: half a spacing and half a step
of heading are mended by three Gauss-Newton steps, which cost less than a finer lattice
and lose less. The number of candidates falls at each step and the rays per candidate
grow. All shapes are fixed, so one compilation serves every scan of a sensor.
"""

import jax
import numpy as np

from fsmsm_jax.alignment.blocks import cut, room_for
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.correlative import rank_poses
from fsmsm_jax.localisation.settle import Localisation, SearchConfig, settle
from fsmsm_jax.localisation.sharding import rank_on_mesh
from fsmsm_jax.localisation.tiles import mesh_of
from fsmsm_jax.sensing.buckets import filled, padded
from fsmsm_jax.sensing.lidar import Scan

__all__ = [
    "check_echoes",
    "localise",
    "localise_batch",
    "query",
    "query_batch",
]

_TOGETHER = 4  # scans of a batch in step: the quickest of 1, 2, 4 and 8 on two cores
_FEWEST_ECHOES = 20  # fewer end points fit somewhere in any building


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
    return _settle_one(atlas.world, scan, _ranked_on_mesh(atlas, scan, config), config)


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
    return settle(atlas.world, scan, _ranked(atlas, scan, config), config)


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
    one = lambda asked: settle(world, asked[0], asked[1], config)
    return jax.lax.map(one, (scans, poses), batch_size=_TOGETHER)


_settle_one, _settle_batch = jax.jit(settle), jax.jit(_settle_each)
