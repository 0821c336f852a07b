"""What the shells rule out, and whether the right place was among it.

A place is kept if a lattice position within a spacing of it is left, from which the
descent finds its way. Of the honest splits, where the map knows nothing of the visit,
and of simulated scans from the open space of the office, 30 % of their rays blocked.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from localisation.rates import percent
from localisation.sets import Options, ScanSet, atlas_of, office_set, real_set

from fsmsm_jax.benchmark import Metric
from fsmsm_jax.localisation.correlative import tiles_left
from fsmsm_jax.localisation.settle import SearchConfig
from fsmsm_jax.sensing.buckets import padded

SPLITS = (
    "mac_9_23",
    "mac_final",
    "intel_first60",
    "freiburg-079_first60",
    "csail_first60",
    "infinite-corridor",
)
RECALL = 99.9  # goal [%]


def pruning(options: Options) -> Iterator[Metric]:
    """Rows of each split, of all splits together, and of the office."""
    everybody = []
    for name in SPLITS:
        kept, left = _kept_and_left(real_set(name, options))
        everybody.append(kept)
        yield Metric(f"pruning/{name}_kept", percent(kept), "%", "higher")
        yield Metric(f"pruning/{name}_left", percent(left), "% of positions", "lower")
    kept = np.concatenate(everybody)
    yield Metric("pruning/real_scans", len(kept), "scans")
    yield Metric("pruning/real_kept", percent(kept), "%", "higher", RECALL)
    kept, left = _kept_and_left(office_set(options.limit or 1000))
    yield Metric("pruning/office_kept", percent(kept), "%", "higher")
    yield Metric("pruning/office_left", percent(left), "% of positions", "lower")


def _kept_and_left(cases: ScanSet) -> tuple[np.ndarray, np.ndarray]:
    """Of each scan: is its place kept, and which share of all positions is left?"""
    atlas = atlas_of(cases.map)
    tiles, spacing = atlas.tiles, atlas.config.spacing
    row, column = jnp.indices(tiles.allowed.shape[1:])
    corner = tiles.corner[:, :, None, None]
    places = atlas.lattice.to_map(corner[:, 0] + row, corner[:, 1] + column)

    @jax.jit
    def one(scan, truth):
        left = tiles_left(tiles, atlas.config, scan.thin(SearchConfig().search_rays))
        near = jnp.linalg.norm(places - truth[:2], axis=-1) < spacing
        return jnp.any(left & near), jnp.sum(left) / jnp.sum(tiles.allowed)

    asked = zip(cases.scans, jnp.asarray(cases.poses, float), strict=True)
    kept, left = zip(*(one(padded(scan), truth) for scan, truth in asked), strict=True)
    return np.array(kept), np.array(left)
