"""Figure 4: microseconds a step at equal particles, and a step of many of both.

All methods are compiled first, then run in turn, again and again, so that what else
the machine does falls on all of them alike.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from thesis.report import Table, number, save

from fsmsm_jax.plotting.slam import plot_run_times
from fsmsm_jax.slam.association import Association
from fsmsm_jax.slam.filter import SlamConfig, init, run
from fsmsm_jax.slam.methods import Name
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.simulate import Circle, Simulated, scatter, simulate
from fsmsm_jax.slam.vehicle import Car
from lslam.runs import METHODS, PARTICLES, Options, verdict

MANY, SEEDS, NEAREST = 100, 20, 10
PEERS = {"fastslam1": 628.0, "fastslam2": 1031.0}
"""PythonRobotics, µs for each particle and step, 8 landmarks, on such a machine."""


class Clocked(NamedTuple):
    """Seconds of a step."""

    median: float
    low: float
    """A quarter of the repetitions were faster."""
    high: float
    """A quarter were slower."""
    steps: np.ndarray
    """Of each repetition."""


def times(options: Options) -> Iterator[Table]:
    """One seed, twenty seeds, many particles and landmarks, and beside others."""
    particles = PARTICLES[:1] if options.quick else (*PARTICLES, MANY)
    alone = {
        count: _clocked({m: _program(m, count, 25, 1) for m in METHODS}, options)
        for count in particles
    }
    yield _table("A step, one seed", alone)
    _draw(options, alone)
    if options.quick:
        return
    batch = {
        count: _clocked({m: _program(m, count, 25, SEEDS) for m in METHODS}, options)
        for count in (PARTICLES[0], PARTICLES[-1])
    }
    yield _table(f"A step of each of {SEEDS} seeds in a batch", batch)
    yield _goals({**alone}, batch)
    yield _many(options)
    yield _peers(options)


def _world(landmarks: int, most: int | None = None) -> tuple[jax.Array, Simulated]:
    start, controls = Circle(laps=1.0).way(Car())
    places = scatter(jax.random.key(0), landmarks)
    key = jax.random.key(1)
    return start, simulate(key, places, start, controls, Car(), RangeBearing(), most)


def _program(
    method: Name,
    particles: int,
    landmarks: int,
    seeds: int,
    rules: Association | None = None,
    most: int | None = None,
) -> Callable[[], int]:
    """Runs a compiled filter through a drive; tells how many steps that were."""
    start, drives = _world(landmarks, most)
    config = SlamConfig(
        method=method, particles=particles, landmarks=landmarks, association=rules
    )
    one = lambda key, drive: run(config, init(config, key, start), drive)[1].pose
    go = jax.jit(jax.vmap(one, in_axes=(0, None)) if seeds > 1 else one)
    keys = jax.random.split(jax.random.key(2), seeds)
    keys = keys if seeds > 1 else keys[0]
    ready = go.lower(keys, drives.drive).compile()
    steps = seeds * len(drives.poses)

    def program():
        jax.block_until_ready(ready(keys, drives.drive))
        return steps

    return program


def _clocked(
    programs: Mapping[str, Callable[[], int]], options: Options
) -> dict[str, Clocked]:
    """Seconds of a step of each, by turns."""
    seconds = {name: [] for name in programs}
    for _ in range(3 if options.quick else 16):
        for name, program in programs.items():
            begun = time.perf_counter()
            steps = program()
            seconds[name].append((time.perf_counter() - begun) / steps)
    clocked = {}
    for name, each in seconds.items():
        warm = np.array(each[1:])
        low, median, high = np.percentile(warm, [25, 50, 75])
        clocked[name] = Clocked(median, low, high, warm)
    return clocked


def _table(title: str, clocked: Mapping[int, Mapping[str, Clocked]]) -> Table:
    head = ("particles", *METHODS, *(f"{a} / {b}" for a, b in RATIOS))
    rows = []
    for count, now in clocked.items():
        cells = [
            f"{1e6 * c.median:.0f} [{1e6 * c.low:.0f}, {1e6 * c.high:.0f}]"
            for c in (now[m] for m in METHODS)
        ]
        rows.append((str(count), *cells, *(_ratio(now, *pair) for pair in RATIOS)))
    note = (
        "µs, median and middle half of 15 repetitions by turns; 25 landmarks, known "
        "association. Ratios: median of those of each turn."
    )
    return Table(title, head, rows, note)


RATIOS = (("lslam", "fastslam1"), ("fastslam2", "lslam"), ("lslam2", "lslam"))


def _value(now: Mapping[str, Clocked], above: str, below: str) -> float:
    return float(np.median(now[above].steps / now[below].steps))


def _ratio(now: Mapping[str, Clocked], above: str, below: str) -> str:
    return f"{_value(now, above, below):.2f}"


def _goals(*runs: Mapping[int, Mapping[str, Clocked]]) -> Table:
    rows = []
    for name, clocked in zip(("one seed", f"{SEEDS} seeds"), runs, strict=True):
        for above, below, goal, met in (
            ("lslam", "fastslam1", "0.8 to 1.2", lambda r: 0.8 <= r <= 1.2),
            ("fastslam2", "lslam", "1.6 or more", lambda r: r >= 1.6),
        ):
            ratios = [_value(now, above, below) for now in clocked.values()]
            text = f"{min(ratios):.2f} to {max(ratios):.2f}"
            met = verdict(all(map(met, ratios)))
            rows.append((f"{above} / {below}, {name}", goal, text, met))
    return Table("Time: goals", ("ratio", "goal", "over all particles", ""), rows)


def _many(options: Options) -> Table:
    """A hundred particles with a hundred landmarks each."""
    rows = []
    for title, rules, most in (
        ("known", None, None),
        (f"unknown, {NEAREST} nearest", Association(), NEAREST),
    ):
        programs = {m: _program(m, MANY, MANY, 1, rules, most) for m in METHODS}
        for method, now in _clocked(programs, options).items():
            rate = 1 / now.median
            rows.append((method, title, f"{rate:.0f}", verdict(rate >= 500)))
    note = f"{MANY} particles of {MANY} landmarks, one seed; goal: 500 steps/s."
    return Table("Steps a second", ("method", "association", "steps/s", ""), rows, note)


def _peers(options: Options) -> Table:
    rows = []
    programs = {m: _program(m, MANY, 8, 1) for m in METHODS}
    for method, now in _clocked(programs, options).items():
        ours = 1e6 * now.median / MANY
        theirs = PEERS.get(method)
        rows.append(
            (
                *(method, number(ours)),
                "" if theirs is None else number(theirs),
                "" if theirs is None else f"{theirs / ours:.0f}",
                "" if theirs is None else verdict(theirs / ours >= 50),
            )
        )
    note = (
        f"µs for each of {MANY} particles and step, 8 landmarks, one seed. Theirs by "
        "the specification, on a machine of this kind; other models, so: magnitudes."
    )
    head = ("method", "ours", "PythonRobotics", "times faster", "goal: 50")
    return Table("Beside PythonRobotics", head, rows, note)


def _draw(options: Options, clocked: Mapping[int, Mapping[str, Clocked]]) -> None:
    if options.out is None:
        return
    figure = Figure(figsize=(7, 4))
    ax = figure.add_subplot()
    groups = {m: [now[m][:3] for now in clocked.values()] for m in METHODS}
    plot_run_times(ax, list(clocked), groups)
    ax.set_title("one seed, 25 landmarks (the paper's figure 4)")
    save(figure, options.out, "lslam_time")
