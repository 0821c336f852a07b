r"""Where am I now? One pose, kept up at sensor rate: predict, correct, fuse, doubt.

Each scan is one step of a filter, a pure function of fixed shapes:

1. **predict**: odometry moves the pose and widens its covariance (`motion`); without
   odometry the robot goes on as it went, less surely;
2. **unsweep**: rays taken while the robot moved are carried to one moment (`sweep`);
3. **correct**: a search from many starts says where the scan fits (`correction`), and
   its covariance says how surely, direction by direction: along a corridor odometry
   speaks, across it the scan;
4. **fuse**: the two opinions, weighted. Where they contradict each other, wheels have
   slipped or the scan fits the wrong place: the one that explains the scan is kept;
5. **doubt**: how well the map explains the scan, ray by ray (`judge`), against how well
   it usually does with this map and this sensor. What is missing adds up from scan to
   scan; too much of it, and the robot is lost, and says so.

`init` and `step` are pure and take one scan; `run` is `lax.scan` over a log. All three
go through `vmap`: many hypotheses, many robots, many seeds.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.information import covariance_root, definite
from fsmsm_jax.localisation.correction import CorrectionConfig, correct
from fsmsm_jax.localisation.gaussian import mean, moved
from fsmsm_jax.localisation.judge import explain
from fsmsm_jax.localisation.motion import OdometryModel, spread
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.sweep import unswept
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["TrackerConfig", "TrackerInfo", "TrackerState", "init", "run", "step"]

_FUSED, _MEASURED, _PREDICTED = range(3)


class TrackerConfig(eqx.Module):
    """How the tracker predicts, searches, and loses faith."""

    odometry: OdometryModel = OdometryModel(drift=(0.2, 0.04))
    """What odometry is worth. Its drift is wide: in a long corridor nothing corrects a
    wheel that is some percent too large, and steps err alike."""
    acceleration: tuple[ScalarLike, ScalarLike] = (0.05, 0.1)
    """Without odometry: how far a motion differs from the last one, 1σ [m, rad]."""
    correction: CorrectionConfig = CorrectionConfig()
    """The search for the pose that the scan says."""
    fewest: ScalarLike = 20
    """Echoes; a scan with fewer corrects nothing."""
    contradiction: ScalarLike = 4.0
    """Standard deviations between odometry and scan, beyond which one of them errs."""
    compromise: ScalarLike = 0.25
    """By how much worse than the scan's own pose the mean of both may explain it, while
    they count as agreeing [nats a ray]."""
    learning: ScalarLike = 0.1
    """Share of a new scan in what is taken for usual."""
    slack: ScalarLike = 0.25
    """By how much a scan may be explained worse than usual, unpunished [nats a ray]."""
    faith: ScalarLike = 0.3
    """How much more than that may add up before the robot is lost [nats a ray]."""
    worst: ScalarLike = -0.6
    """No first scan that is explained worse is taken for usual [nats a ray]."""


class TrackerState(NamedTuple):
    """All that is kept from scan to scan."""

    pose: Float[Array, "3"]
    """Of the lidar in the map frame at the last scan [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Of the pose [m, m, rad]²."""
    motion: Float[Array, "3"]
    """The last motion: the pose in the frame of the one before [m, m, rad]."""
    odometry: Float[Array, "3"]
    """The last odometry reading; NaN if there was none."""
    deviation: Float[Array, ""]
    """By how much ranges usually deviate from this map [m]; NaN before the first."""
    score: Float[Array, ""]
    """How well the map usually explains a scan [nats a ray]; NaN before the first."""
    doubt: Float[Array, ""]
    """What has added up against the pose [nats a ray]."""


class TrackerInfo(NamedTuple):
    """What one step found; what one would plot."""

    pose: Float[Array, "3"]
    """Of the lidar in the map frame [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Of the pose [m, m, rad]²."""
    predicted: Float[Array, "3"]
    """Where the robot was expected [m, m, rad]."""
    measured: Float[Array, "3"]
    """Where the scan alone puts it [m, m, rad]."""
    corrected: Bool[Array, ""]
    """Whether the scan had a say; without, the pose is the prediction."""
    caer_per_ray: Float[Array, ""]
    """Mean |real − virtual range| where sensor and map both see something [m]."""
    score: Float[Array, ""]
    """Mean log-likelihood of a ray (`judge.explain`)."""
    explained: Float[Array, ""]
    """Share of the valid rays that the map explains."""
    doubt: Float[Array, ""]
    """What has added up against the pose [nats a ray]."""
    lost: Bool[Array, ""]
    """Whether that is too much: the pose is not to be trusted."""


def init(
    world: OccupancyGrid | PolygonMap | None,
    pose: Float[Array, "3"],
    covariance: Float[Array, "3 3"] | None = None,
    odometry: Float[Array, "3"] | None = None,
) -> TrackerState:
    """A tracker that starts from a pose.

    Args:
        world: the map; it is not looked at, and None will do.
        pose: of the lidar in the map frame [m, m, rad].
        covariance: of the pose [m, m, rad]²; 0.1 m and 3° if left out.
        odometry: what odometry read there [m, m, rad], if it did.
    """
    del world
    pose = jnp.asarray(pose, float)
    if covariance is None:
        covariance = jnp.diag(jnp.array([0.1, 0.1, 0.05]) ** 2)
    return TrackerState(
        pose=pose,
        covariance=jnp.asarray(covariance, pose.dtype),
        motion=jnp.zeros_like(pose),
        odometry=_reading(odometry, pose),
        deviation=jnp.full_like(pose[0], jnp.nan),
        score=jnp.full_like(pose[0], jnp.nan),
        doubt=jnp.zeros_like(pose[0]),
    )


@jax.jit
def step(
    world: OccupancyGrid | PolygonMap,
    state: TrackerState,
    scan: Scan,
    odometry: Float[Array, "3"] | None = None,
    moments: Float[Array, "rays"] | None = None,
    config: TrackerConfig = TrackerConfig(),
) -> tuple[TrackerState, TrackerInfo]:
    """One scan on.

    Args:
        world: the map.
        state: what the last step left.
        scan: the new scan, of any field of view; dirty rays are masked in it.
        odometry: pose of the lidar in the odometry frame now [m, m, rad]. Only its
            change since the last step counts; NaN, then or now, or None: unknown.
        moments: when each ray was taken, in intervals from the last scan (−1) to this
            one (0), to compensate the motion meanwhile (`sensing.unswept`).
        config: settings.

    Returns:
        The next state, and what was found. All finite, whatever the scan holds: one
        with too few echoes corrects nothing, and `info.corrected` says so.

    Note:
        Compiled once per shape of map and scan; with and without `moments` are two
        programs, with and without `odometry` one, if NaN says that there is none.
    """
    odometry = _reading(odometry, state.pose)
    motion, predicted, expected = _predict(state, odometry, config)
    if moments is not None:
        scan = unswept(scan, motion, moments)
    still, on = state.pose, geometry.compose(state.pose, state.motion)
    back = geometry.compose(state.pose, geometry.inverse(motion))
    measured, thickness, deviation = correct(
        *(world, scan, predicted, expected),
        others=jnp.stack([still, on, back]),
        usual=state.deviation,
        config=config.correction,
    )
    root = covariance_root(world, scan, measured, thickness)

    # Three opinions, the mean of the two among them, and what each makes of the scan.
    fused, spread_fused, distance = mean(predicted, expected, measured, root)
    poses = jnp.stack([fused, measured, predicted])
    evidence = jax.vmap(lambda pose: explain(world, scan, pose, thickness))(poses)
    choice = _choose(evidence.score, distance, config)
    informative = jnp.sum(scan.echo) >= config.fewest
    choice = jnp.where(informative, choice, _PREDICTED)
    pose = poses[choice]
    spreads = jnp.stack([spread_fused, definite(root @ root.T), expected])
    covariance = spreads[choice]
    evidence = jax.tree.map(lambda a: a[choice], evidence)

    corrected = choice != _PREDICTED
    usual, doubt = _doubt(state, evidence.score, informative, config)
    learned = _learn(state.deviation, deviation, config.learning)
    state = TrackerState(
        pose=pose,
        covariance=covariance,
        motion=geometry.between(state.pose, pose),
        odometry=odometry,
        deviation=jnp.where(corrected, learned, state.deviation),
        score=usual,
        doubt=doubt,
    )
    info = TrackerInfo(
        pose=pose,
        covariance=covariance,
        predicted=predicted,
        measured=measured,
        corrected=corrected,
        caer_per_ray=evidence.caer_per_ray,
        score=evidence.score,
        explained=evidence.explained,
        doubt=doubt,
        lost=doubt > config.faith,
    )
    return state, info


@jax.jit
def run(
    world: OccupancyGrid | PolygonMap,
    state: TrackerState,
    scans: Scan,
    odometry: Float[Array, "scans 3"] | None = None,
    moments: Float[Array, "scans rays"] | None = None,
    config: TrackerConfig = TrackerConfig(),
) -> tuple[TrackerState, TrackerInfo]:
    """`step` through a whole log, as one program.

    Args:
        world: the map.
        state: from `init`.
        scans: stacked along a leading axis (`ScanLog.scans`).
        odometry: a row a scan, as in `step`.
        moments: a row a scan, as in `step`.
        config: settings.

    Returns:
        The last state, and the infos stacked along a leading axis. A robot that is
        called lost, be it that a crowd came in, stays so: only a look at the whole map
        can tell, and `follow` takes it.
    """
    one = lambda state, reading: step(world, state, *reading, config=config)
    return jax.lax.scan(one, state, (scans, odometry, moments))


def _reading(odometry, like):
    """Odometry as the pose it is, or NaN for none."""
    if odometry is None:
        return jnp.full_like(like, jnp.nan)
    return jnp.asarray(odometry, like.dtype)


def _predict(state, odometry, config):
    """The motion since the last scan, where it leads, and how surely."""
    counted = geometry.between(state.odometry, odometry)
    known = jnp.all(jnp.isfinite(counted))
    motion = jnp.where(known, counted, state.motion)
    away, turn = config.acceleration
    free = jnp.diag(jnp.array([away, away, turn], motion.dtype) ** 2)
    Q = jnp.where(known, spread(config.odometry, motion), free)
    return motion, *moved(state.pose, state.covariance, motion, Q)


def _choose(score, distance, config):
    """Which of mean, scan and prediction to believe."""
    agree = (distance < config.contradiction**2) & (
        score[_FUSED] > score[_MEASURED] - config.compromise
    )
    better = score[_MEASURED] > score[_PREDICTED]
    return jnp.where(agree, _FUSED, jnp.where(better, _MEASURED, _PREDICTED))


def _learn(usual, now, share):
    """The usual deviation drifts towards the present one, in its logarithm."""
    now = jnp.maximum(now, 0.01)
    learned = usual * jnp.exp(share * jnp.clip(jnp.log(now / usual), -1.0, 1.0))
    return jnp.where(jnp.isnan(usual), now, learned)


def _doubt(state, score, informative, config):
    """What is usual, and what has added up against the pose (a one-sided CUSUM)."""
    first = jnp.isnan(state.score)
    usual = jnp.where(first, jnp.maximum(score, config.worst), state.score)
    missing = usual - score
    doubt = jnp.maximum(state.doubt + missing - config.slack, 0.0)
    calm = missing < config.slack
    usual = jnp.where(calm, usual - config.learning * missing, usual)
    return (
        jnp.where(informative, usual, state.score),
        jnp.where(informative, doubt, state.doubt),
    )
