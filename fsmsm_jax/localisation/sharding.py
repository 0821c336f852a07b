"""One map on many devices: each keeps and ranks its share of the tiles.

A large map is many tiles, and tiles know nothing of each other. So they are laid out
over a `Mesh` of devices, of one process or of several that `jax.distributed` has
joined: each device correlates its own tiles with the scan and lists its best, the lists
are gathered (some ten thousand numbers), and everybody picks the same best of all. The
scan's images are shared out as well, by headings. What follows, from some thousand
poses to an answer, costs the same whatever the map, and each process does it on a
device of its own, where the map itself is.

The candidates are those of one device, to the last digit as a rule: a tile's arithmetic
does not know where it runs.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array

from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.correlative import (
    Box,
    Ranking,
    all_headings,
    best_of_all,
    rank_tiles,
    scan_spectra,
    tiles_left,
)
from fsmsm_jax.localisation.tiles import mesh_of
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["rank_on_mesh"]


def rank_on_mesh(
    atlas: ScanAtlas, scan: Scan, rays: int, headings: int, count: int
) -> Array:
    """Poses (count, 3) as `rank_poses` finds them, on this process's own device.

    Args:
        atlas: one that was spread over a mesh.
        scan: the real scan, or many along a leading axis; the same in every process.
        rays: that are ranked by.
        headings: how many to try, an even number.
        count: how many poses to return at most.
    """
    mesh = mesh_of(atlas.tiles)
    assert mesh is not None
    # As NumPy: what lies on one device of one process cannot be read by the others.
    scan, lattice = jax.tree.map(np.asarray, (scan, atlas.lattice))
    ranking = _rank(
        atlas.tiles, lattice, scan, atlas.config, rays, headings, count, mesh
    )
    return jnp.asarray(np.asarray(ranking.poses.addressable_data(0)))


@partial(jax.jit, static_argnames=("rays", "headings", "count", "mesh"))
def _rank(tiles, lattice, scans, config, rays, headings, count, mesh):
    shared, whole = PartitionSpec(*mesh.axis_names), PartitionSpec()
    share = -(-headings // mesh.size)
    box = Box.of(config.spacing, headings)

    @partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(shared, shared, whole),
        out_specs=shared,
        check_vma=False,  # tiles are skipped by branches that know of no device
    )
    def rank_share(spectra, left, scan):
        device = jax.lax.axis_index(mesh.axis_names)
        theta = all_headings(headings)[(device * share + jnp.arange(share)) % headings]
        some = scan_spectra(config, tiles.side, scan, theta)
        every = jax.lax.all_gather(some, mesh.axis_names, tiled=True)[:headings]
        return rank_tiles(spectra, left, every, box, count)

    def one(scan) -> Ranking:
        thin = scan.thin(rays)
        listed = rank_share(tiles.spectra, tiles_left(tiles, config, thin), thin)
        gathered, near = jax.lax.with_sharding_constraint(
            (listed, tiles), NamedSharding(mesh, whole)
        )
        return best_of_all(gathered, near, lattice, headings, box, count)

    found = one(scans) if scans.ranges.ndim == 1 else jax.lax.map(one, scans)
    return jax.lax.with_sharding_constraint(found, NamedSharding(mesh, whole))
