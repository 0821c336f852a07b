"""Pairs of scans to match, the two ways to do it, and how long they take."""

import dataclasses
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.alignment import (
    FastConfig,
    FsmsmConfig,
    Match,
    fsm,
    match_scans_batch,
)
from fsmsm_jax.evaluation import FARTHEST, Cases, nees, noisy, scan_to_scan
from fsmsm_jax.sensing import Scan

FAST, FAITHFUL = "fast", "FSM"
WAYS = (FAST, FAITHFUL)
_KEY = jax.random.key(0)  # of recoveries
_STRAY = 1.5  # boxes: their corners, whichever way the sensor is turned

PROGRAM = {FAST: FastConfig(stray=_STRAY), FAITHFUL: FsmsmConfig.scan_to_scan()}
"""By us, and as the thesis's program was run by others: I_T = 2 (1 + ν)."""


def of_the_thesis(box: tuple[float, float]) -> dict[str, FastConfig | FsmsmConfig]:
    """As in its evaluation: I_T = 5 (1 + ν), and all are told the displacement's box."""
    faithful = dataclasses.replace(FsmsmConfig.scan_to_scan(5), box=box, stray=_STRAY)
    return {
        FAST: FastConfig(stray=_STRAY, box=(box[0], box[1])),
        FAITHFUL: faithful,
    }


def _match(config, references: Scan, scans: Scan, guesses: jax.Array):
    """The thesis's without a verdict, which it has not, for the same answers as its."""
    rays = scans.ranges.shape[1]
    if isinstance(config, FastConfig):
        return match_scans_batch(references, scans, guesses, config, rays=rays)
    return fsm(references, scans, guesses, config, rays, _KEY)


class Pairs(NamedTuple):
    """Two scans each, and where the second was taken, seen from the first."""

    references: Scan
    scans: Scan
    guesses: jax.Array
    true: jax.Array


class Answers(NamedTuple):
    """What a way to match made of pairs."""

    position: np.ndarray
    """Errors [m]."""
    orientation: np.ndarray
    """Errors [rad]."""
    converged: np.ndarray
    nees: float
    """Of the answers that converged, mean; NaN where no covariance is given."""
    seconds: float
    """For a match, all pairs in one call, compiling left out."""


def pairs_of(cases: Cases, sigma: float) -> Pairs:
    """Both scans of each case, with their noise."""
    pair = scan_to_scan(cases, sigma)
    references = jnp.linalg.norm(pair.outlines, axis=-1)
    _, scans = noisy(pair, sigma)
    return Pairs(_scans(references), _scans(scans), pair.initial, pair.true)


def _scans(ranges: jax.Array) -> Scan:
    count, rays = ranges.shape
    bearings = jnp.linspace(-jnp.pi, jnp.pi, rays, endpoint=False)
    ones = jnp.ones(ranges.shape, bool)
    around = jnp.broadcast_to(bearings, ranges.shape)
    return Scan(ranges, around, ones, ones, jnp.full(count, FARTHEST))


def answers(pairs: Pairs, config: FastConfig | FsmsmConfig, again: int = 1) -> Answers:
    """Match them, and once more to take the time."""
    given = pairs.references, pairs.scans, pairs.guesses
    call = lambda: jax.block_until_ready(_match(config, *given))
    found, seconds = call(), []
    for _ in range(again):
        begun = time.perf_counter()
        found = call()
        seconds.append(time.perf_counter() - begun)
    off = np.asarray(found.pose - pairs.true, float)
    turn = np.abs(np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi)
    converged = np.asarray(found.converged)
    honest = np.nan
    if isinstance(found, Match):
        honest = float(
            np.mean(nees(found.pose, pairs.true, found.covariance)[converged])
        )
    return Answers(
        np.hypot(off[:, 0], off[:, 1]),
        turn,
        converged,
        honest,
        float(np.median(seconds)) / len(turn),
    )
