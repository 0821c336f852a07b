"""Pairs of scans to match, the two ways to do it, and how long they take."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.alignment import FsmsmConfig, fsm, match_scans_batch
from fsmsm_jax.evaluation import FARTHEST, Cases, noisy, scan_to_scan
from fsmsm_jax.sensing import Scan

FAST, FAITHFUL = "fast", "FSM"
WAYS = (FAST, FAITHFUL)
_KEY = jax.random.key(0)  # of recoveries


def _match(way: str, references: Scan, scans: Scan, guesses: jax.Array):
    """By us, or as the thesis does: without a guard, for the same answers as its."""
    rays = scans.ranges.shape[1]
    if way == FAST:
        return match_scans_batch(references, scans, guesses, rays=rays)
    config = FsmsmConfig.scan_to_scan()
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


def answers(pairs: Pairs, way: str, again: int = 1) -> Answers:
    """Match them, and once more to take the time."""
    given = pairs.references, pairs.scans, pairs.guesses
    call = lambda: jax.block_until_ready(_match(way, *given))
    found, seconds = call(), []
    for _ in range(again):
        begun = time.perf_counter()
        found = call()
        seconds.append(time.perf_counter() - begun)
    off = np.asarray(found.pose - pairs.true, float)
    turn = np.abs(np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi)
    return Answers(
        np.hypot(off[:, 0], off[:, 1]),
        turn,
        np.asarray(found.converged),
        float(np.median(seconds)) / len(turn),
    )
