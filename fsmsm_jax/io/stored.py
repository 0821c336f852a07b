"""A tracker or a query in one file, for a robot that has to be up at once.

The file holds the trace of `tracker.step`, or of `localise`, and the map or the atlas
that it works on (see `programs`). To load it and take the first scan needs neither the
map's files nor the seconds of tracing, and what it computes stays what it was when the
file was written, whatever becomes of the code.

A file serves scans of one number of rays, on the platforms that it was written for;
`sensing.buckets.padded` brings scans of nearby numbers to one.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from fsmsm_jax.io.programs import Program
from fsmsm_jax.localisation import search, tracker
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.search import check_echoes
from fsmsm_jax.localisation.settle import Candidates, Localisation, SearchConfig
from fsmsm_jax.localisation.tracker import TrackerConfig, TrackerInfo, TrackerState
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "ANSWER",
    "StoredQuery",
    "StoredTracker",
    "load_query",
    "load_tracker",
    "save_query",
    "save_tracker",
]


def _hollow(kind: Any, **parts: Any) -> Any:
    """A NamedTuple without contents, for its structure."""
    return kind(**dict.fromkeys(kind._fields, 0) | parts)


ANSWER: Localisation = _hollow(Localisation, candidates=_hollow(Candidates))
"""Of the structure of what a query gives; its leaves say nothing."""
_ANSWER, _STATE, _INFO = map(
    jax.tree.structure, (ANSWER, _hollow(TrackerState), _hollow(TrackerInfo))
)


class StoredTracker:
    """The tracker of a file: `init` and `step` as in `tracker`, less the map."""

    def __init__(self, program: Program):
        self._step = program.compiled()
        self.with_moments = bool(program.about["moments"])
        """Whether `step` compensates the motion during a scan, and wants moments."""

    def init(
        self,
        pose: Float[Array, "3"] | Shaped[np.ndarray, "3"],
        covariance: Float[Array, "3 3"] | Shaped[np.ndarray, "3 3"] | None = None,
        odometry: Float[Array, "3"] | Shaped[np.ndarray, "3"] | None = None,
    ) -> TrackerState:
        """A tracker that starts from a pose; see `tracker.init`."""
        given = (None if a is None else jnp.asarray(a) for a in (covariance, odometry))
        return tracker.init(None, jnp.asarray(pose, float), *given)

    def step(
        self,
        state: TrackerState,
        scan: Scan,
        odometry: Float[Array, "3"] | Shaped[np.ndarray, "3"] | None = None,
        moments: Float[Array, "rays"] | Shaped[np.ndarray, "rays"] | None = None,
    ) -> tuple[TrackerState, TrackerInfo]:
        """One scan on; see `tracker.step`.

        Raises:
            ValueError: the scan has another number of rays than the file is for, or
                moments are missing or of no use.
        """
        if (moments is not None) != self.with_moments:
            raise ValueError(
                "this tracker was stored with moments of the rays, and wants them"
                if self.with_moments
                else "this tracker was stored without moments; save one with them"
            )
        if odometry is None:
            odometry = np.full(3, np.nan)
        leaves = self._step(state, scan, odometry, moments)
        cut = _STATE.num_leaves
        return (
            jax.tree.unflatten(_STATE, leaves[:cut]),
            jax.tree.unflatten(_INFO, leaves[cut:]),
        )


class StoredQuery:
    """The search of a file through one atlas; call it with a scan."""

    def __init__(self, program: Program):
        self._locate = program.compiled()
        self.reach = float(program.about["reach"])
        """Echoes beyond it do not count [m]."""

    def __call__(self, scan: Scan) -> Localisation:
        """Where in the map was this scan taken? See `localise`.

        Raises:
            ValueError: the scan has another number of rays than the file is for, or
                fewer than 20 echoes within reach.
        """
        check_echoes(scan, self.reach)
        return jax.tree.unflatten(_ANSWER, self._locate(scan))


def save_tracker(
    path: str | Path,
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    moments: Float[Array, "rays"] | Shaped[np.ndarray, "rays"] | None = None,
    config: TrackerConfig = TrackerConfig(),
    *,
    platforms: Sequence[str] | None = None,
) -> None:
    """Write a tracker on a map for scans like this one.

    Args:
        path: the file to write.
        world: the map.
        scan: a scan of the sensor; only its number of rays matters.
        moments: when its rays were taken, if the tracker is to compensate the motion
            meanwhile; only that there are any matters.
        config: settings.
        platforms: "cpu", "cuda", ...; the present one if left out.

    Raises:
        ValueError: the scan is not one scan, or the file cannot be written.

    Example:
        >>> import fsmsm_jax as fj
        >>> scan = fj.Scan.from_ranges([3.0] * 8, 0.0, 0.7)
        >>> world = fj.load_map("map.yaml")  # doctest: +SKIP
        >>> save_tracker("robot.fsmsm", world, scan)  # doctest: +SKIP
        >>> robot = load_tracker("robot.fsmsm")  # doctest: +SKIP
        >>> state = robot.init([1.0, 2.0, 0.5])  # doctest: +SKIP
        >>> state, info = robot.step(state, scan)  # doctest: +SKIP
    """
    _check(scan)
    step = lambda world, *rest: tracker.step(world, *rest, config)
    state = jax.eval_shape(lambda: tracker.init(world, jnp.zeros(3)))
    odometry = jax.ShapeDtypeStruct((3,), state.pose.dtype)
    arguments = (state, scan, odometry, moments)
    Program.trace(
        *("tracker", step, world, arguments, platforms), moments=moments is not None
    ).save(path)


def load_tracker(path: str | Path) -> StoredTracker:
    """A tracker that `save_tracker` wrote.

    Raises:
        ValueError: the file is missing, torn, no tracker, of another version, or not
            for this machine's platform.
    """
    return StoredTracker(Program.load(path, "tracker"))


def save_query(
    path: str | Path,
    atlas: ScanAtlas,
    scan: Scan,
    config: SearchConfig = SearchConfig(),
    *,
    platforms: Sequence[str] | None = None,
) -> None:
    """Write the search through an atlas for scans like this one.

    Args:
        path: the file to write.
        atlas: of the map.
        scan: a scan of the sensor; only its number of rays matters.
        config: how hard to look.
        platforms: "cpu", "cuda", ...; the present one if left out.

    Raises:
        ValueError: the scan is not one scan, or the file cannot be written.
    """
    _check(scan)
    locate = lambda atlas, scan: search.query(atlas, scan, config)
    Program.trace(
        *("query", locate, atlas, (scan,), platforms), reach=atlas.config.reach
    ).save(path)


def load_query(path: str | Path) -> StoredQuery:
    """A query that `save_query` wrote.

    Raises:
        ValueError: the file is missing, torn, no query, of another version, or not for
            this machine's platform.
    """
    return StoredQuery(Program.load(path, "query"))


def _check(scan) -> None:
    if np.ndim(scan.ranges) != 1:
        raise ValueError(
            f"expected one scan with (rays,) ranges, got shape {np.shape(scan.ranges)}"
        )
