"""The published evaluation of scan-to-map matchers, from cases to tables.

A matcher is any function `match(worlds, ranges, poses)` of a batch of polygon maps
(fields with a leading axis), real scans (batch, rays) and initial poses (batch, 3). It
returns an object with arrays `pose` (batch, 3), `converged`, `scans` (virtual scans
cast), `steps` and `recoveries` (batch,), as `alignment.fsmsm` does. What the matcher
should know besides, such as the noise its stopping rule is told, is bound before.

One `match_row` is one box of a box plot: a matcher at one level of noise. All rows draw
on the same cases and the same noise draws, so they can be compared case by case; each
keeps its errors for that. Success is the thesis's: the pose error
sqrt(dx² + dy² + dθ²), metres and radians mixed, came down. A matcher that returns what
it is given succeeds never, and neither does one that returns NaN.

Nothing here prints, plots or writes; numbers in the README come from `scripts/`.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from fsmsm_jax.evaluation.cases import FARTHEST, Cases, noisy
from fsmsm_jax.evaluation.estimates import (
    Estimate,
    Spread,
    mean_of,
    share_of,
    spread_of,
)
from fsmsm_jax.evaluation.metrics import pose_errors
from fsmsm_jax.world import PolygonMap

__all__ = [
    "Errors",
    "Match",
    "Row",
    "degree_sweep",
    "match_errors",
    "match_row",
    "match_table",
    "range_limit_sweep",
]

Match = Callable[[PolygonMap, Float[Array, "batch rays"], Float[Array, "batch 3"]], Any]
"""(worlds, ranges, initial poses) → pose, converged, scans, steps, recoveries."""


class Errors(NamedTuple):
    """What became of each case, on the host: the raw material of a row."""

    position: Float[np.ndarray, "cases"]
    """Distance of the answer from the true position [m]."""
    orientation: Float[np.ndarray, "cases"]
    """Angle between the answer's heading and the true one [rad], at least 0."""
    pose: Float[np.ndarray, "cases"]
    """Root of the sum of both squared, the thesis's pose error [(m² + rad²)^½]."""
    before: Float[np.ndarray, "cases"]
    """The same of the initial pose."""
    success: Bool[np.ndarray, "cases"]
    """Whether `pose` is less than `before`."""
    converged: Bool[np.ndarray, "cases"]
    """Whether the matcher says so."""
    scans: Num[np.ndarray, "cases"]
    """Virtual scans cast."""
    steps: Num[np.ndarray, "cases"]
    """Iterations of its outer loop."""
    recoveries: Num[np.ndarray, "cases"]
    """How often it started again from another pose."""
    in_range: Float[np.ndarray, "cases"]
    """Share of the real scan's rays that met something within the sensor's reach."""


class Row(NamedTuple):
    """One matcher at one level of noise."""

    sigma_R: float
    """Standard deviation of the ranges [m]."""
    sigma_M: float
    """Standard deviation of the map's vertices, per coordinate [m]."""
    n: int
    """Number of cases."""
    success: Estimate
    """Share of cases whose pose error came down."""
    position: Spread
    """Position error [m]."""
    orientation: Spread
    """Orientation error [rad]."""
    pose: Spread
    """Pose error [(m² + rad²)^½]."""
    scans: Spread
    """Virtual scans per match."""
    steps: Spread
    """Outer iterations per match."""
    recoveries: Estimate
    """Mean recoveries per match."""
    converged: Estimate
    """Share of cases that the matcher calls converged."""
    errors: Errors
    """Case by case, in the order of the cases."""


def match_table(
    cases: Cases,
    match: Match,
    sigmas_R: Sequence[float] = (0.01, 0.03, 0.05, 0.10, 0.20),
    sigmas_M: Sequence[float] = (0.0, 0.05),
    batch: int = 64,
) -> list[Row]:
    """A row for each pair of noise levels, σ_M outside and σ_R inside, as published.

    Args:
        cases: the same for all rows.
        match: the matcher, the same for all rows; to tell it the noise, call
            `match_row` with one matcher a row instead.
        sigmas_R: standard deviations of the ranges [m]; the thesis's if left out.
        sigmas_M: standard deviations of the map [m]; the thesis's if left out.
        batch: cases handed to the matcher at once.

    Reference:
        Thesis §6.5, figures 6.23 to 6.33.
    """
    return [
        match_row(cases, match, sigma_R, sigma_M, batch)
        for sigma_M in sigmas_M
        for sigma_R in sigmas_R
    ]


def match_row(
    cases: Cases,
    match: Match,
    sigma_R: float = 0.0,
    sigma_M: float = 0.0,
    batch: int = 64,
    range_max: float = FARTHEST,
) -> Row:
    """Run a matcher on all cases at one level of noise, and sum up.

    Args:
        cases: worlds, poses, scans and noise draws.
        match: the matcher.
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of each coordinate of the map's vertices [m].
        batch: cases handed to the matcher at once. All batches have this size, so that
            a jitted matcher compiles once: the last is filled up with the first case.
        range_max: reach of the sensor [m]; what is farther reads just this.

    Note:
        A row is arithmetic on `match_errors`; with several E (repeats), concatenate
        the cases before.
    """
    errors = match_errors(cases, match, sigma_R, sigma_M, batch, range_max)
    return Row(
        sigma_R=sigma_R,
        sigma_M=sigma_M,
        n=len(errors.position),
        success=share_of(errors.success),
        position=spread_of(errors.position),
        orientation=spread_of(errors.orientation),
        pose=spread_of(errors.pose),
        scans=spread_of(errors.scans),
        steps=spread_of(errors.steps),
        recoveries=mean_of(errors.recoveries),
        converged=share_of(errors.converged),
        errors=errors,
    )


def match_errors(
    cases: Cases,
    match: Match,
    sigma_R: float = 0.0,
    sigma_M: float = 0.0,
    batch: int = 64,
    range_max: float = FARTHEST,
) -> Errors:
    """What became of each case; see `match_row` for the arguments.

    Raises:
        ValueError: no cases, or a batch of less than one.
    """
    count = len(cases.true)
    if count == 0 or batch < 1:
        raise ValueError(f"{count} cases in batches of {batch}: nothing to match")
    parts = []
    for some, real in _batches(cases, min(batch, count)):
        worlds, ranges = noisy(some, sigma_R, sigma_M)
        ranges = jnp.minimum(ranges, range_max)
        found = match(worlds, ranges, some.initial)
        part = _judged(found.pose, some.true, some.initial) | {
            "converged": found.converged,
            "scans": found.scans,
            "steps": found.steps,
            "recoveries": found.recoveries,
            "in_range": jnp.mean(ranges < range_max, axis=1),
        }
        parts.append({name: np.asarray(field)[:real] for name, field in part.items()})
    return Errors(
        **{name: np.concatenate([p[name] for p in parts]) for name in Errors._fields}
    )


@jax.jit
def _judged(found, true, initial):
    position, orientation = pose_errors(found, true)
    pose = jnp.hypot(position, orientation)
    before = jnp.hypot(*pose_errors(initial, true))
    return {
        "position": position,
        "orientation": orientation,
        "pose": pose,
        "before": before,
        "success": pose < before,
    }


def _batches(cases: Cases, batch: int) -> Iterator[tuple[Cases, int]]:
    """Cases by the batch, and how many of them are not filling."""
    count = len(cases.true)
    for start in range(0, count, batch):
        index = np.arange(start, start + batch)
        index[index >= count] = 0
        yield jax.tree.map(lambda a, i=index: a[i], cases), min(batch, count - start)


def degree_sweep(
    cases: Cases,
    make: Callable[[int], Match],
    degrees: Sequence[int] = range(7),
    sigma_R: float = 0.0,
    sigma_M: float = 0.0,
    batch: int = 64,
) -> list[Row]:
    """What the largest sampling degree ν_max buys: a row for each.

    Args:
        cases: the same for all rows.
        make: from ν_max to the matcher.
        degrees: the ν_max to try.
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of the map [m].
        batch: cases handed to the matcher at once.

    Reference:
        Thesis §6.3: with uf, ν_min = 0 and no noise, both mean errors halve to quarter
        with every degree.
    """
    return [match_row(cases, make(d), sigma_R, sigma_M, batch) for d in degrees]


def range_limit_sweep(
    cases: Cases,
    make: Callable[[float], Match],
    limits: Sequence[float],
    sigma_R: float = 0.05,
    sigma_M: float = 0.0,
    batch: int = 64,
) -> list[Row]:
    """How a matcher bears a sensor that sees less: a row for each reach.

    Rays that meet nothing within reach read the reach itself, in the real scan and, if
    the matcher is made with that `range_max`, in the virtual ones. Each row's
    `errors.in_range` says what share of rays was left; plot errors over that.

    Args:
        cases: the same for all rows.
        make: from the reach r_max [m] to the matcher.
        limits: reaches [m].
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of the map [m].
        batch: cases handed to the matcher at once.

    Reference:
        Thesis §6.6: errors stay nominal while 80 % of the rays are in range.
    """
    return [
        match_row(cases, make(limit), sigma_R, sigma_M, batch, limit)
        for limit in limits
    ]
