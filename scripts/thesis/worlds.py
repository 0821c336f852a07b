"""Cases to ask, from recordings or made up, and matchers that keep the time."""

import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.published import METHODS, SCANS

from fsmsm_jax.alignment import Alignment, FsmsmConfig, fsmsm
from fsmsm_jax.evaluation import (
    DISPLACEMENTS,
    FARTHEST,
    Cases,
    close_half_scans,
    draw_cases,
    simulated_half_scans,
)
from fsmsm_jax.world import buildings

OURS = "ours"
NAMES = (OURS, "fm", "uf", "x1")


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    worlds: int = 2000
    pairs: int = 1_000_000
    quick: bool = False
    out: Path | None = None
    data: Path | None = None
    golden: Path | None = None
    methods: tuple[str, ...] = NAMES


class Asked(NamedTuple):
    """Cases, and the set that each is from."""

    cases: Cases
    sets: np.ndarray
    """Index into `names`."""
    names: tuple[str, ...]
    generated: bool
    """Whether the worlds are made up, for want of recordings."""

    @property
    def described(self) -> str:
        """For the note under a table."""
        count, names = len(self.sets), ", ".join(self.names)
        if self.generated:
            return f"{count} worlds of generated offices (no recordings at hand)."
        parts = " in equal parts" if len(self.names) > 1 else ""
        return f"{count} worlds{parts} of {names}."


def five_sets(
    options: Options,
    key: int = 0,
    worlds: int | None = None,
    displacement: tuple[float, float] = DISPLACEMENTS[-1],
) -> Asked:
    """Equal parts of the five recordings of §6.5; more than there are come again."""
    wanted = min(options.worlds, worlds or options.worlds)
    per_set = max(1, wanted // len(SCANS))
    file = options.data and options.data / "thesis" / "environments.npz"
    if file and file.is_file():
        with np.load(file) as arrays:
            halves = {name: arrays[f"{name}_ranges"] for name in SCANS}
        return _asked(halves, per_set, key, displacement)
    offices = _offices(len(SCANS), per_set)
    return _asked(offices, per_set, key, displacement, generated=True)


def laserazos(options: Options, key: int = 1, worlds: int | None = None) -> Asked:
    """The 778 scans on which the thesis takes the stages apart."""
    wanted = min(options.worlds, worlds or options.worlds)
    file = options.data and options.data / "thesis" / "censi.npz"
    if file and file.is_file():
        with np.load(file) as arrays:
            ranges = arrays["ranges"]
        spread = ranges[:: max(1, len(ranges) // wanted)]
        return _asked({"laserazos": spread}, wanted, key)
    return _asked(_offices(1, wanted), wanted, key, generated=True)


def _offices(count: int, scans: int) -> dict[str, np.ndarray]:
    """Half scans in so many generated floors."""
    floors = {}
    for seed in range(count):
        floor = buildings.office(seed, width=30.0, height=20.0)
        ranges, _ = simulated_half_scans(jax.random.key(seed), floor, scans)
        floors[f"office {seed}"] = np.asarray(ranges)
    return floors


def _asked(
    halves: dict[str, np.ndarray],
    per_set: int,
    key: int,
    displacement: tuple[float, float] = DISPLACEMENTS[-1],
    generated: bool = False,
) -> Asked:
    """One case in each world."""
    outlines, poses = [], []
    for ranges in halves.values():
        closed = close_half_scans(ranges)
        again = np.arange(per_set) % len(closed.poses)
        outlines.append(closed.outlines[again])
        poses.append(closed.poses[again])
    worlds = np.concatenate(outlines), np.concatenate(poses)
    drawn = draw_cases(jax.random.key(key), *worlds, *displacement)
    sets = np.repeat(np.arange(len(halves)), per_set)
    return Asked(drawn, sets, tuple(halves), generated)


@jax.jit(static_argnames="block")
def _match(worlds, ranges, poses, config, range_max, block):
    return fsmsm(worlds, ranges, poses, config, range_max=range_max, block=block)


_compiled: dict[Any, Any] = {}


class Matcher:
    """`fsmsm` with its settings bound, compiled apart from the time it takes.

    Noise levels and ranges are traced: matchers that differ in these share a compile.
    """

    def __init__(self, config: FsmsmConfig, range_max: float = FARTHEST):
        self.arguments = jax.tree.map(jnp.asarray, (config, range_max))
        self.seconds: list[float] = []
        """Of each call, compiling left out."""
        self.compile_seconds = 0.0

    def __call__(self, worlds, ranges, poses) -> Alignment:
        arguments = (worlds, ranges, poses, *self.arguments)
        shapes = tuple(a.shape for a in jax.tree.leaves(arguments))
        # The many candidates of a published step fill the cores by themselves.
        block = 32 if self.arguments[0].finish else 8
        program = jax.tree.structure(arguments), shapes
        if program not in _compiled:
            start = time.perf_counter()
            lowered = _match.lower(*arguments, block=block)
            _compiled[program] = lowered.compile()
            self.compile_seconds = time.perf_counter() - start
        start = time.perf_counter()
        found = jax.block_until_ready(_compiled[program](*arguments))
        self.seconds.append(time.perf_counter() - start)
        return found


def config_of(name: str, sigma_R: float = 0.0, sigma_M: float = 0.0) -> FsmsmConfig:
    """Our default, or what the thesis's program had, which is told the noise."""
    if name == OURS:
        return FsmsmConfig()
    return FsmsmConfig.published(METHODS[name], sigma_R, sigma_M)


def climbing(top: int, finish: int = 0) -> FsmsmConfig:
    """The uf of §6.3: from ν = 0 to `top`, without a CAER limit."""
    levels = tuple(range(top + 1))
    return FsmsmConfig(
        orientation="procrustes",
        levels=levels,
        translations=tuple(1 + nu for nu in levels),
        memory="turn",
        stray=math.inf,
        finish=finish,
    )


def progress(text: str) -> None:
    """A line that says what takes so long."""
    print(f"... {text}", file=sys.stderr, flush=True)
