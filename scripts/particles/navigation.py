"""The thesis's two worlds: one way through each, driven again and again."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table, interval, number

from fsmsm_jax import Lidar, Scan, load_map
from fsmsm_jax.evaluation import quantile_of
from fsmsm_jax.evaluation.drives import drive, plan, record
from fsmsm_jax.localisation.clouds import init_at
from fsmsm_jax.localisation.feedback import Feedback, ScanMatching, Selection
from fsmsm_jax.localisation.likelihood import LikelihoodField
from fsmsm_jax.localisation.motion import OdometryModel
from fsmsm_jax.localisation.particles import ParticleConfig, run
from fsmsm_jax.world import OccupancyGrid
from particles.published import FEEDBACKS, SELECTIONS, Published

CLEARANCE = 0.8  # [m] that the simulated robot keeps where it can
SPEED, TURN_RATE = 0.5, 1.0  # [m/s, rad/s]
QUICK_SCANS = 30
WHEELS = OdometryModel(  # of the simulation: Gazebo's wheels hardly slip
    turn_per_turn=0.05,
    turn_per_metre=0.02,
    metre_per_metre=0.05,
    metre_per_turn=0.01,
    floor=(0.001, 0.001),
    drift=(0.0, 0.0),
)
BELIEVED = OdometryModel.amcl(0.2)  # of the filter: amcl's default α
INITIAL = np.diag([0.25, 0.25, 0.06854])  # the thesis's covariance at the start

CHOICES = {
    "heaviest 10 %": Selection("absolute", 0.1),
    "above the mean": Selection("relative"),
    "all": Selection("absolute", 1.0),
    "heaviest one": Selection("absolute", 0.0),
}
TOLD = {
    "open": Feedback("open"),
    "soft_1": Feedback("soft_1"),
    "soft_50": Feedback("soft_p", 0.5),
    "hard": Feedback("hard"),
    "soft_1, weight of all": Feedback("soft_1", clone_unit="sum"),
    "soft_50, weight of all": Feedback("soft_p", 0.5, clone_unit="sum"),
}

HEAD = (
    *("", "filter alone [95 %]", "published", "with scan matching", "published"),
    *("position / heading", "matched", "particles"),
)
GOALS_HEAD = ("better", "worse", "medians", "better in")


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    seeds: int = 100
    rate_hz: float = 5.0
    quick: bool = False
    data: Path | None = None


class Place(NamedTuple):
    """Where the thesis drove."""

    name: str
    start: tuple[float, float, float]
    goal: tuple[float, float]
    note: str


CORRIDOR = Place("corridor", (11.56, 12.20, 0.0), (5.0, 6.0), "")
WAREHOUSE = Place(
    "warehouse",
    (2.08, 2.08, 0.0),
    (40.0, 14.06),
    " The map at hand lies turned by -90° against the thesis's coordinates, start "
    "(17.98, 2.08, π/2) and goal (6, 40): both are turned with it.",
)


class Log(NamedTuple):
    """One way, driven `seeds` times."""

    world: OccupancyGrid
    poses: jax.Array
    """True poses (times, 3), in all repetitions the same."""
    odometry: jax.Array
    scans: Scan
    """(seeds, times, rays)."""


class Errors(NamedTuple):
    """Of each repetition, the mean over its way."""

    alone: np.ndarray
    """‖e‖ of the filter's output (seeds,)."""
    matched: np.ndarray
    """‖e‖ after scan matching."""
    metres: np.ndarray
    radians: np.ndarray
    share: float
    """Of the outputs that were matched."""
    particles: float


def corridor(options: Options) -> Iterator[Table]:
    """The thesis's CORRIDOR."""
    yield from _navigate(options, CORRIDOR)


def warehouse(options: Options) -> Iterator[Table]:
    """The thesis's WAREHOUSE."""
    yield from _navigate(options, WAREHOUSE)


def _navigate(options: Options, place: Place) -> Iterator[Table]:
    path = options.data and options.data / f"maps/phd_li9i_csv__{place.name}.yaml"
    if path is None or not path.is_file():
        print(f"... {place.name}: the map is not at hand", file=sys.stderr)
        return
    log = _driven(load_map(path), place, options)
    note = (
        f"{options.seeds} drives of {len(log.poses)} scans, {SPEED} m/s, {options.rate_hz} "
        "scans/s; 260°, 640 rays, 30 m, σ 0.01 m; 60 rays weigh 200 to 500 particles, "
        "180 are matched. Medians of the mean ‖e‖ in (m² + rad²)^½; position [m] and "
        "heading [rad] are the filter's alone. Grid of 0.01 m, what nobody has seen "
        "is free in it." + place.note
    )
    one = lambda kind, name: _errors(log, options, **{kind: name})
    chosen = {n: one("selection", c) for n, c in CHOICES.items()}
    rows = [_row(n, e, SELECTIONS[n], place) for n, e in chosen.items()]
    title = f"{place.name.upper()}: which particles are the output (open loop)"
    yield Table(title, HEAD, rows, note)
    told = {n: one("feedback", f) for n, f in TOLD.items() if n != "open"}
    told = {"open": chosen["all"], **told}
    rows = [_row(n, e, FEEDBACKS.get(n), place) for n, e in told.items()]
    yield Table(
        f"{place.name.upper()}: what the filter is told (output: mean of all)",
        HEAD,
        rows,
        "Weight of a clone: the mean of all; in the last rows the sum of all.",
    )
    yield Table(f"{place.name.upper()}: goals", GOALS_HEAD, _goals(chosen, told))


def _driven(world: OccupancyGrid, place: Place, options: Options) -> Log:
    lidar = Lidar.create(640, np.radians(260), 30.0, 0.01)
    way = plan(world, place.start[:2], place.goal, CLEARANCE)
    key_once, key_often = jax.random.split(jax.random.key(0))
    once = drive(
        *(key_once, world, lidar, way, SPEED, TURN_RATE, options.rate_hz, WHEELS),
        start_heading=place.start[2],
    )
    poses = once.poses[:QUICK_SCANS] if options.quick else once.poses
    keys = jax.random.split(key_often, options.seeds)
    again = jax.jit(jax.vmap(record, (0, None, None, None, None)))
    return Log(world, poses, *again(keys, world, lidar, poses, WHEELS))


def _errors(
    log: Log,
    options: Options,
    selection: Selection = Selection(),
    feedback: Feedback = Feedback(),
) -> Errors:
    start = time.perf_counter()
    config = ParticleConfig(
        motion=BELIEVED,
        likelihood=LikelihoodField(),
        selection=selection,
        matching=ScanMatching(),
        feedback=feedback,
    )
    keys = jax.random.split(jax.random.key(1), options.seeds)
    infos = _repeated(keys, log, config)
    used = np.asarray(infos.updated)
    alone, metres, radians = _mean_errors(infos.pose, log.poses, used)
    matched, *_ = _mean_errors(infos.corrected, log.poses, used)
    seconds = time.perf_counter() - start
    print(f"... {selection} {feedback}: {seconds:.0f} s", file=sys.stderr)
    return Errors(
        *(alone, matched, metres, radians),
        share=float(np.asarray(infos.matched)[used].mean()),
        particles=float(np.asarray(infos.living).mean()),
    )


@jax.jit
def _repeated(keys, log, config):
    """All drives at once, each with its own noise and its own particles."""

    def one(key, odometry, scans):
        key_begin, key_run = jax.random.split(key)
        about = jnp.asarray(INITIAL, log.poses.dtype)
        cloud = init_at(key_begin, log.poses[0], about, config)
        return run(key_run, log.world, cloud, scans, odometry, config)[1]

    return jax.vmap(one)(keys, log.odometry, log.scans)


def _mean_errors(poses, true, used):
    off = np.asarray(poses, float) - np.asarray(true, float)[None]
    off[..., 2] = np.remainder(off[..., 2] + np.pi, 2 * np.pi) - np.pi
    metres, radians = np.hypot(off[..., 0], off[..., 1]), np.abs(off[..., 2])
    mean = lambda e: (e * used).sum(axis=1) / used.sum(axis=1)
    return mean(np.hypot(metres, radians)), mean(metres), mean(radians)


def _row(name: str, errors: Errors, published: Published | None, place: Place):
    printed = getattr(published, place.name) if published else ("", "")
    return (
        name,
        interval(quantile_of(errors.alone)),
        *(str(printed[0]), interval(quantile_of(errors.matched)), str(printed[1])),
        " / ".join(number(np.median(e)) for e in (errors.metres, errors.radians)),
        f"{100 * errors.share:.1f} %",
        f"{errors.particles:.0f}",
    )


def _goals(chosen: dict[str, Errors], told: dict[str, Errors]):
    names = list(chosen)
    pairs = [
        (a, chosen[a].alone, b, chosen[b].alone)
        for a, b in zip(names, names[1:], strict=False)
    ]
    pairs += [
        ("soft_50", told["soft_50"].alone, b, told[b].alone) for b in ("open", "hard")
    ]
    pairs.append(("scan matching", told["open"].matched, "open", told["open"].alone))
    return [
        (
            *(a, b),
            f"{number(np.median(x))} {'<' if np.median(x) < np.median(y) else '>='} "
            f"{number(np.median(y))}",
            f"{np.sum(x < y)} of {x.size} drives",
        )
        for a, x, b, y in pairs
    ]
