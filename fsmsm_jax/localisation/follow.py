r"""The whole of it: localised out of nothing, tracked, lost, and found again.

Global localisation, pose tracking and the kidnapped robot are the three problems of the
thesis's first chapter; `follow` solves them as one. It is in one of two states:

- **tracking**: `tracker.step`, milliseconds. When doubt has added up, the whole map is
  asked (`localise`). Does it know places that explain the scan clearly better, they are
  tracked beside the old one, until they have beaten it (kidnapped) or it leads again;
  else the scan is strange from anywhere, and doubt was unfounded;
- **lost**: at the start, or after a kidnap. A sure answer of `localise` ends it. If the
  scan alone cannot decide, each of its candidates is tracked, all in one `vmap`, until
  one leads: equal rooms part at the next door.

What was tracked comes out scan by scan, so nothing is lost when a log breaks off.
"""

from collections.abc import Iterable, Iterator
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from fsmsm_jax.localisation import tracker
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.contest import (
    begun,
    deposed,
    going_on,
    leader,
    winner,
)
from fsmsm_jax.localisation.search import localise
from fsmsm_jax.localisation.settle import Localisation, SearchConfig
from fsmsm_jax.localisation.tracker import TrackerConfig, TrackerInfo, TrackerState
from fsmsm_jax.sensing.buckets import padded, padded_rays
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["Fix", "FollowConfig", "Reading", "follow"]

_AGAIN = 20  # scans after which a contest without a winner starts over
_SEE_ENOUGH = 20  # echoes that `localise` wants


class FollowConfig(eqx.Module):
    """How the two states give way to each other."""

    tracker: TrackerConfig = TrackerConfig()
    """Of each step."""
    search: SearchConfig = SearchConfig()
    """Of each global localisation."""
    better: float = 0.2
    """A place has to explain the scan this much better than the tracked one, and about
    as well as usual, before the robot counts as kidnapped [nats a ray]."""
    still_open: float = 0.7
    """Of the rays that the tracked place cannot explain, it may leave this share."""
    overthrow: float = 1.0
    """By how much it has to, added up over scans [nats a ray]: kidnaps are rare, and
    among all places some explain a strange scan better by chance."""
    lead: float = 0.6
    """What the first of several candidates leads by, added up over scans, when it is
    believed [nats a ray]."""
    explained: float = 0.6
    """Share of the rays that the map explains from there, at least."""
    apart: tuple[float, float] = (0.5, 0.3)
    """Candidates nearer to each other than this [m, rad] are one place."""


class Reading(NamedTuple):
    """What arrives with one turn of the lidar."""

    scan: Scan
    odometry: Float[Array, "3"] | Shaped[np.ndarray, "3"] | None = None
    """Pose of the lidar in the odometry frame [m, m, rad]; NaN or None if unknown."""
    moments: Float[Array, "rays"] | Shaped[np.ndarray, "rays"] | None = None
    """When each ray was taken (`sensing.unswept`), −1 being the scan before. Moments
    after the stamp (> 0) want odometry: a motion guessed from the last poses swings."""


class Fix(NamedTuple):
    """Where the lidar is, as of one scan. NumPy throughout."""

    pose: Float[np.ndarray, "3"]
    """Of the lidar in the map frame [m, m, rad]; NaN before it was ever localised."""
    covariance: Float[np.ndarray, "3 3"]
    """Of the pose [m, m, rad]²; says nothing while the robot is lost."""
    status: Literal["tracking", "skipped", "doubted", "localised", "lost"]
    """`skipped`: dead reckoning, the scan had too little to say. `doubted`: tracking
    goes on, but scans have been strange. `localised`: found on the whole map. `lost`:
    the pose is the best guess, and not to be trusted."""
    caer_per_ray: float
    """Mean |real − virtual range| where sensor and map both see something [m]."""
    explained: float
    """Share of the valid rays that the map explains."""
    doubt: float
    """What has added up against the pose [nats a ray]."""


def follow(
    atlas: ScanAtlas,
    readings: Iterable[Reading],
    initial: Float[Array, "3"] | Shaped[np.ndarray, "3"] | None = None,
    config: FollowConfig = FollowConfig(),
) -> Iterator[Fix]:
    """Where the lidar is, scan by scan, whatever happens to it.

    Args:
        atlas: of the map.
        readings: scans as they come, with odometry or without; of any number of rays,
            but each bucket of them (`sensing.buckets`) is compiled on its own.
        initial: pose of the lidar at the first scan [m, m, rad], to some decimetres;
            without, it is found.
        config: settings.

    Yields:
        One fix a reading, as soon as it is computed.

    Raises:
        ValueError: `initial` is not three finite numbers.
    """
    robot = None
    if initial is not None:
        initial = np.asarray(initial, float)
        if initial.shape != (3,) or not np.isfinite(initial).all():
            raise ValueError(
                f"an initial pose is [x, y, θ], three finite numbers, got {initial}; "
                "leave it out to have it found"
            )
        robot = tracker.init(atlas.world, jnp.asarray(initial))
    origin = np.full(3, np.nan)
    for reading in readings:
        if reading.odometry is not None:
            # Only increments count, and float32 keeps millimetres near nought only.
            counted = np.asarray(reading.odometry, float)
            if not np.isfinite(origin).all():
                origin = counted * [1.0, 1.0, 0.0]
            reading = reading._replace(odometry=jnp.asarray(counted - origin))
        scan, moments = padded(reading.scan), reading.moments
        if moments is not None:
            moments = padded_rays(moments, len(scan.ranges))
        reading = reading._replace(scan=scan, moments=moments)
        go_on = _track if isinstance(robot, TrackerState) else _search
        robot, fix = go_on(atlas, robot, reading, config)
        yield fix


def _track(atlas, state, reading, config):
    """One step; and if doubt has added up, a look at the whole map."""
    state, info = tracker.step(atlas.world, state, *reading, config.tracker)
    if not info.lost:
        return state, _fix(info, "tracking" if info.corrected else "skipped")
    found = _ask(atlas, reading.scan, config)
    if found is None:
        return state, _fix(info, "doubted" if info.corrected else "skipped")
    if not _better(found, state, info, config):
        # Strange from anywhere. On the verge of doubt, and slowly getting used to it.
        usual = state.score + config.tracker.learning * (info.score - state.score)
        doubt = jnp.minimum(state.doubt, config.tracker.faith)
        return state._replace(score=usual, doubt=doubt), _fix(info, "doubted")
    # What the tracked place fell short of in earlier scans counts against it as well.
    total = float(state.score - config.tracker.slack - info.doubt)
    if found.candidates.likelihood[0] - total > config.overthrow:
        return _answer(atlas.world, found, reading.odometry)
    contest = begun(atlas.world, found.candidates, reading.odometry, (state, total))
    return contest, _fix(info, "doubted")


def _better(found, state, info, config):
    """Whether another place explains the scan clearly better, and as well as usual."""
    score = found.candidates.likelihood[0]
    as_usual = score > state.score - config.tracker.slack
    explains = 1 - found.explained < config.still_open * (1 - info.explained)
    return (score > info.score + config.better) & as_usual & explains


def _search(atlas, contest, reading, config):
    """Ask the map, or what has become of its candidates."""
    if contest is not None and (contest.scans < _AGAIN or contest.incumbent):
        scan, odometry, moments = reading
        contest, infos = going_on(
            atlas.world, contest, scan, odometry, moments, config.tracker
        )
        return _decide(contest, infos, config)
    found = _ask(atlas, reading.scan, config)
    if found is None:
        nowhere = np.full(3, np.nan), np.diag([np.inf] * 3)
        return None, Fix(*nowhere, "lost", np.inf, 0.0, 0.0)
    return _answer(atlas.world, found, reading.odometry)


def _decide(contest, infos, config):
    """Who leads by enough? An incumbent has to be beaten, not merely led."""
    first, lead, stays = leader(contest, config.apart)
    of = lambda index, status: _fix(jax.tree.map(lambda a: a[index], infos), status)
    if stays and (lead > config.lead or contest.scans >= _AGAIN):
        return winner(contest, first), of(first, "tracking")
    if contest.incumbent:
        rest = 1 - infos.explained
        beaten = contest.totals[first] - contest.totals[0] > config.overthrow
        beaten &= rest[first] < config.still_open * rest[0]
        if not beaten and contest.scans < _AGAIN:
            return contest, of(0, "doubted")
        if not beaten:
            return winner(contest, 0), of(0, "tracking")
    fits = contest.totals[first] / contest.scans > config.tracker.worst
    if lead > config.lead and fits and infos.explained[first] > config.explained:
        return winner(contest, first), of(first, "localised")
    lost = deposed(contest) if contest.incumbent else contest
    return lost, of(first, "lost")


def _ask(atlas, scan, config) -> Localisation | None:
    """`localise`, if there is enough to see."""
    near = np.asarray(scan.echo) & (np.asarray(scan.ranges) < atlas.config.reach)
    if np.sum(near) < _SEE_ENOUGH:
        return None
    return localise(atlas, scan, config.search)


def _answer(world, found, odometry):
    """A tracker, if the whole map has one answer; else a contest of its candidates."""
    status = "localised" if found.confident else "lost"
    fix = Fix(
        np.asarray(found.pose),
        np.asarray(found.covariance),
        status,
        float(found.caer_per_ray),
        float(found.explained),
        0.0,
    )
    if found.confident:
        return tracker.init(world, found.pose, found.covariance, odometry), fix
    return begun(world, found.candidates, odometry), fix


def _fix(info: TrackerInfo, status) -> Fix:
    return Fix(
        np.asarray(info.pose),
        np.asarray(info.covariance),
        status,
        float(info.caer_per_ray),
        float(info.explained),
        float(info.doubt),
    )
