"""A SLAM filter driven through a log in legs, with as many slots as its map takes.

A whole drive in one call would say nothing for a minute, and would have to be told at
the start how many landmarks there are: a slot costs time in every step, whether it
holds one or not. So the drive is cut into legs of equal length, for which one program
is compiled. A leg after which a map is nearly full is driven again from where it began,
with twice the slots: what comes out is what had come out of so many from the start.

Legs are made equal by steps of nothing in front of the first, where the map is empty.
Behind the last, landmarks in view would be missed in them and lose evidence.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from fsmsm_jax.cli.console import timed
from fsmsm_jax.io.landmarks import LandmarkLog
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.filter import Info, SlamConfig, State, init, run
from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.methods import METHODS

__all__ = ["FEWEST", "Driven", "drive_through"]

FEWEST = 64
"""Slots to begin with where there may be more."""

_LEG = 500  # steps, at most
_MOST = {False: 4096, True: 512}  # slots; fewer where all landmarks are correlated
_FULL = 0.9  # share of the slots above which a map is nearly full


class Driven(NamedTuple):
    """What a filter made of a log."""

    info: Info
    """Of all steps, NumPy arrays."""
    landmarks: Landmarks
    """At the end, of the heaviest particle."""
    compiling: float
    """Time that it took to compile [s]."""
    seconds: float
    """Time that the steps took [s], of legs driven again too."""


def drive_through(
    config: SlamConfig, log: LandmarkLog, seed: int, *, grow: bool
) -> Driven:
    """Run a filter through a log, with a bar on stderr if that is a terminal.

    Args:
        config: the filter.
        log: one drive.
        seed: of all draws.
        grow: whether it may have more slots than it begins with.
    """
    steps = len(log.times)
    legs = -(-steps // _LEG)
    length = -(-steps // legs)
    drive = _led_in(log.drive, legs * length - steps)
    # As arrays, numbers are no part of the program that is compiled and kept.
    config = jax.tree.map(jnp.asarray, config)
    state = init(config, jax.random.key(seed), jnp.asarray(log.start, float))
    program, compiling, seconds, infos = None, 0.0, 0.0, []
    with tqdm(total=steps, unit="step", desc="slam", disable=None) as bar:
        while len(infos) < legs:
            now = slice(len(infos) * length, (len(infos) + 1) * length)
            leg = jax.tree.map(lambda a, now=now: a[now], drive)
            if program is None:
                program, taken = timed(run.lower(config, state, leg).compile)
                compiling += taken
            (after, info), taken = timed(partial(program, config, state, leg))
            seconds += taken
            if grow and _crowded(config, after, info):
                config = replace(config, landmarks=2 * config.landmarks)
                state, program = _roomier(config, state), None
                continue
            state = after
            infos.append(jax.tree.map(np.asarray, info))
            bar.set_postfix_str(f"{info.known[-1]} landmarks", refresh=False)
            bar.update(min(length, steps - bar.n))
    info = jax.tree.map(lambda *a: np.concatenate(a)[-steps:], *infos)
    return Driven(info, state.landmarks, compiling, seconds)


def _led_in(drive: Drive, steps: int) -> Drive:
    """With steps in front in which nothing moves and nothing is seen."""
    nothing = jax.tree.map(lambda a: np.zeros_like(a[:1]), drive)
    nothing = nothing._replace(detections=np.ones_like(nothing.detections))
    return jax.tree.map(lambda a, b: np.concatenate([*[a] * steps, b]), nothing, drive)


def _crowded(config: SlamConfig, state: State, info: Info) -> bool:
    """Whether there should be more slots, and may be."""
    if 2 * config.landmarks > _MOST[METHODS[config.method].joint]:
        return False
    fullest = int(jnp.max(jnp.sum(state.particles.landmarks.known, axis=-1)))
    return bool(info.unplaced.any()) or fullest > _FULL * config.landmarks


def _roomier(config: SlamConfig, state: State) -> State:
    """The same particles with the slots that the filter has now."""
    blank = init(config, state.key).particles
    put = lambda old, new: new.at[tuple(map(slice, old.shape))].set(old)
    return state._replace(particles=jax.tree.map(put, state.particles, blank))
