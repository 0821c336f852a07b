"""A whole log at once: `follow`, with readings from arrays and its fixes stacked."""

import operator
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Shaped
from tqdm import tqdm

from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.follow import Fix, FollowConfig, Reading, follow
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["Track", "stacked", "track"]


class Track(NamedTuple):
    """Fixes of a whole log, stacked; see `Fix`."""

    pose: Float[np.ndarray, "scans 3"]
    covariance: Float[np.ndarray, "scans 3 3"]
    status: Shaped[np.ndarray, "scans"]
    caer_per_ray: Float[np.ndarray, "scans"]
    explained: Float[np.ndarray, "scans"]
    doubt: Float[np.ndarray, "scans"]

    @classmethod
    def of(cls, fixes: Sequence[Fix]) -> "Track":
        """Fixes, stacked; at least one."""
        columns = zip(*fixes, strict=True)
        return cls(*(np.stack([np.asarray(cell) for cell in one]) for one in columns))


def track(
    atlas: ScanAtlas,
    scans: Scan,
    odometry: Float[Array, "scans 3"] | Shaped[np.ndarray, "scans 3"] | None = None,
    initial: Float[Array, "3"] | Shaped[np.ndarray, "3"] | None = None,
    moments: Float[Array, "scans rays"]
    | Shaped[np.ndarray, "scans rays"]
    | None = None,
    config: FollowConfig = FollowConfig(),
    *,
    progress: bool = False,
) -> Track:
    """`follow` a whole log.

    Args:
        atlas: of the map.
        scans: the log's scans, stacked along a leading axis (`ScanLog.scans`).
        odometry: poses of the lidar in the odometry frame [m, m, rad]; NaN rows where
            there is none.
        initial: as in `follow`.
        moments: as in `Reading`, a row a scan (`sensing.moments`).
        config: settings.
        progress: show a bar on stderr.

    Raises:
        ValueError: as `follow`; or the scans are not stacked, or odometry and moments
            are not of their number.
    """
    readings = stacked(scans, odometry, moments)
    count = len(np.asarray(scans.ranges))
    fixes = follow(atlas, readings, initial, config)
    bar = tqdm(fixes, total=count, disable=not progress, unit="scan")
    return Track.of(list(bar))


def stacked(scans, odometry=None, moments=None) -> Iterator[Reading]:
    """The readings of a log, one by one; arguments and errors as in `track`."""
    if np.ndim(scans.ranges) != 2 or not len(scans.ranges):
        raise ValueError(
            f"expected scans with (scans, rays) ranges, got {np.shape(scans.ranges)}; "
            "stack them, or give single ones to `follow`"
        )
    count = len(scans.ranges)
    for name, rows in (("odometry", odometry), ("moments", moments)):
        if rows is not None and len(rows) != count:
            raise ValueError(f"{name} has {len(rows)} rows for {count} scans")
    # Rows of NumPy arrays are views; rows of device arrays would be programs.
    scans = jax.tree.map(np.asarray, scans)
    none = [None] * count
    odometry = none if odometry is None else np.asarray(odometry, float)
    moments = none if moments is None else np.asarray(moments, scans.ranges.dtype)
    rows = zip(range(count), odometry, moments, strict=True)
    return (
        Reading(jax.tree.map(operator.itemgetter(n), scans), *others)
        for n, *others in rows
    )
