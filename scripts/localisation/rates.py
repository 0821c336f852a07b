"""What many answers are worth: how often right, how far off, how long each took."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from localisation.sets import Answers, ScanSet, world_of

from fsmsm_jax.benchmark import Metric
from fsmsm_jax.evaluation import cramer_rao_bound, pose_errors, position_rms, success


def rates(
    name: str,
    cases: ScanSet,
    answers: Answers,
    right: float | None = None,
    limit: float = 0.3,
    wrong_goal: float = 0.5,
) -> Iterator[Metric]:
    """How often right, how often sure, and how often both wrong and sure."""
    good = is_right(cases, answers, limit)
    wrong = answers.confident & ~good
    yield Metric(f"{name}/scans", len(good), "scans")
    yield Metric(f"{name}/right", percent(good), "%", "higher", right, 0.03)
    yield Metric(
        f"{name}/confident", percent(answers.confident), "%", "higher", None, 0.1
    )
    yield Metric(
        f"{name}/sure_but_wrong", percent(wrong), "%", "lower", wrong_goal, 0.0
    )


def among_candidates(
    name: str, cases: ScanSet, answers: Answers, goal: float, limit: float = 0.3
) -> Iterator[Metric]:
    """How often the right place is one of those that the answer names."""
    truth = np.repeat(cases.poses[:, None], answers.candidates.shape[1], axis=1)
    good = success(jnp.asarray(answers.candidates), jnp.asarray(truth, float), limit)
    share = percent(np.asarray(good).any(axis=1))
    yield Metric(f"{name}/among_candidates", share, "%", "higher", goal)


def errors(
    name: str,
    cases: ScanSet,
    answers: Answers,
    position_goal: float | None = None,
    orientation_goal: float | None = None,
    limit: float = 0.3,
    unit: str = "cm",
    gated: bool = False,
) -> Iterator[Metric]:
    """Median errors of the right answers."""
    good = is_right(cases, answers, limit)
    position, orientation = pose_errors(
        jnp.asarray(answers.poses[good]), jnp.asarray(cases.poses[good])
    )
    metres = {"cm": 1e2, "mm": 1e3}[unit] * median(position)
    degrees = np.rad2deg(median(orientation))
    worse = 0.3 if gated else None
    yield Metric(f"{name}/position", metres, unit, "lower", position_goal, worse)
    yield Metric(f"{name}/orientation", degrees, "°", "lower", orientation_goal, worse)


def efficiency(name: str, cases: ScanSet, answers: Answers) -> Iterator[Metric]:
    """Errors of the right answers over the Cramér–Rao bound at their places."""
    world, scan = world_of(cases.map), cases.scans[0]
    bound = lambda pose: position_rms(
        cramer_rao_bound(world, pose, scan.bearings, scan.range_max, sigma=0.05)
    )
    good = is_right(cases, answers, limit=0.5)
    truth = jnp.asarray(cases.poses[good], float)
    least = np.asarray(jax.jit(jax.vmap(bound))(truth))
    error, _ = pose_errors(jnp.asarray(answers.poses[good]), truth)
    rms = lambda a: float(np.sqrt(np.mean(np.square(a))))
    yield Metric(f"{name}/bound", 1e3 * median(least), "mm", "lower")
    yield Metric(f"{name}/error_to_bound", median(error / least), "×", "lower", 1.3)
    yield Metric(f"{name}/rmse_to_rms_bound", rms(error) / rms(least), "×", "lower")


def query_times(
    name: str, answers: Answers, goal: float | None = None
) -> Iterator[Metric]:
    """Milliseconds of one query, refinement and all, and seconds of the first."""
    low, middle, high = 1e3 * np.percentile(answers.seconds, (10, 50, 90))
    yield Metric(f"{name}/query", middle, "ms", "lower", goal)
    yield Metric(f"{name}/query_p10", low, "ms", "lower")
    yield Metric(f"{name}/query_p90", high, "ms", "lower")
    yield Metric(f"{name}/first_query", answers.first, "s", "lower")


def is_right(cases: ScanSet, answers: Answers, limit: float) -> np.ndarray:
    poses, truth = jnp.asarray(answers.poses), jnp.asarray(cases.poses, float)
    return np.asarray(success(poses, truth, limit))


def percent(flags) -> float:
    return 100 * float(np.mean(flags))


def median(values) -> float:
    """The median, NaN (which reaches no goal) of nothing."""
    return float(np.median(values)) if np.size(values) else np.nan
