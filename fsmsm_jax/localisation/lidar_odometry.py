"""A whole log at once: where did the lidar go, by its scans alone?

The steps are those of `odometer`; here the input is looked at, the log cut into pieces
of one length, so that one compiled program serves them all, and what came out stacked
and named. Odometry knows no place, only the way from the start: its frame is that of
the lidar at the first scan, and the covariance grows with every keyframe.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from fsmsm_jax.localisation.odometer import LidarOdometryConfig, init, run
from fsmsm_jax.sensing import Scan

__all__ = ["LidarOdometry", "lidar_odometry"]

_BLOCK = 256  # scans that are handed to the compiled program


class LidarOdometry(NamedTuple):
    """The way through a log, a row a scan."""

    pose: Float[np.ndarray, "scans 3"]
    """Of the lidar, in its frame at the first scan [m, m, rad]."""
    covariance: Float[np.ndarray, "scans 3 3"]
    """Of the pose [m, m, rad]²; it grows with the way."""
    status: Shaped[np.ndarray, "scans"]
    """"keyframe", "matched", "skipped" (too few echoes) or "doubted" (it fits nowhere);
    the latter two have the prediction's pose."""
    agreement: Float[np.ndarray, "scans"]
    """Share of the echoes that agree with a keyframe."""
    known: Float[np.ndarray, "scans"]
    """Share of the echoes that fall on walls which some keyframe saw."""
    deviation: Float[np.ndarray, "scans"]
    """Standard deviation that the residuals show [m]."""


def lidar_odometry(
    scans: Scan,
    config: LidarOdometryConfig = LidarOdometryConfig(),
) -> LidarOdometry:
    """The way of a lidar through a log, by its scans alone.

    Args:
        scans: of one sensor, stacked along a leading axis (`ScanLog.scans`), in order.
        config: settings.

    Returns:
        Poses in the frame of the first scan, their covariances, and what became of each
        scan. One with too few echoes is skipped, and is no error.

    Raises:
        ValueError: the scans are not stacked, there are none, they have fewer than 8
            rays, their arrays differ in shape, or they differ in `range_max`.

    Example:
        >>> import numpy as np
        >>> from fsmsm_jax import Lidar, PolygonMap, raycast
        >>> room = PolygonMap.from_outlines([[1, 1], [7, 1], [7, 4], [2, 5]])
        >>> lidar = Lidar.create(180, noise=0.01)
        >>> poses = jnp.array([[3.0 + 0.1 * n, 2.0, 0.05 * n] for n in range(6)])
        >>> exact = jax.vmap(raycast, (None, 0, None))(room, poses, lidar.bearings)
        >>> keys = jax.random.split(jax.random.key(0), 6)
        >>> scans = jax.vmap(lidar.measure)(keys, exact)
        >>> way = lidar_odometry(scans)
        >>> bool(np.abs(way.pose[-1] - [0.5, 0.0, 0.25]).max() < 0.02)
        True

    Note:
        One program for all logs of over 256 scans; some milliseconds a scan.
    """
    shape = np.shape(scans.ranges)
    if len(shape) != 2 or shape[0] < 1 or shape[1] < 8:
        raise ValueError(
            "expected scans stacked along a leading axis, with (scans ≥ 1, rays ≥ 8) "
            f"ranges, got shape {shape}"
        )
    shapes = [np.shape(a) for a in (scans.bearings, scans.valid, scans.echo)]
    if any(other != shape for other in shapes):
        raise ValueError(
            f"bearings, valid and echo must have shape {shape} as the ranges have, "
            f"got {shapes}"
        )
    limits = np.broadcast_to(np.asarray(scans.range_max), shape[:1])
    if not (np.isfinite(limits).all() and (limits == limits[0]).all()):
        raise ValueError(
            "the scans must be of one sensor, with one finite range_max, got "
            f"{np.unique(limits)}"
        )
    scans = eqx.tree_at(lambda s: s.range_max, scans, jnp.asarray(limits))

    state, parts = init(config), []
    length = min(_BLOCK, shape[0])
    for begin in range(0, shape[0], length):
        # The last block is filled up with its last scan: one program for all.
        rows = np.minimum(np.arange(begin, begin + length), shape[0] - 1)
        block = jax.tree.map(lambda a, rows=rows: a[rows], scans)
        state, info = run(state, block, config)
        parts.append(jax.tree.map(np.asarray, info))
    found = jax.tree.map(lambda *a: np.concatenate(a)[: shape[0]], *parts)
    status = np.select(
        [~found.enough, found.keyframe & found.matched, found.matched],
        ["skipped", "keyframe", "matched"],
        "doubted",
    )
    status[np.argmax(found.enough)] = "keyframe" if found.enough.any() else "skipped"
    return LidarOdometry(
        pose=found.pose,
        covariance=found.covariance,
        status=status,
        agreement=found.agreement,
        known=found.known,
        deviation=found.deviation,
    )
