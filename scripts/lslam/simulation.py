"""Figure 2b: errors against particles where the truth and every landmark are known."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from thesis.report import Table, number, save

from fsmsm_jax.evaluation.estimates import Paired, paired
from fsmsm_jax.evaluation.slam import WayError, way_error
from fsmsm_jax.plotting.slam import plot_particle_errors, plot_slam
from fsmsm_jax.slam.filter import SlamConfig
from fsmsm_jax.slam.methods import Name
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.simulate import Circle, Simulated, scatter, simulate
from fsmsm_jax.slam.vehicle import Car
from lslam.runs import Numbers, Options, error_of, found, gain, spread, verdict

LANDMARKS = 25
PAPER_SEEDS, FIXED_SEEDS, JOINT_SEEDS, QUICK_SEEDS = 20, 100, 50, 8
CORRELATED: tuple[tuple[Name, int], ...] = (
    *(("lslam_joint", 5), ("lslam_joint", 10)),
    ("ekf", 1),
)
PROTOTYPE = {  # of the specification, one fixed world
    "fastslam1": {5: 0.245, 10: 0.185, 20: 0.152, 40: 0.153},
    "fastslam2": {5: 0.158, 10: 0.153, 20: 0.141, 40: 0.137},
    "lslam": {5: 0.186, 10: 0.156, 20: 0.154, 40: 0.138},
}
HEAD = (
    *("particles", "method", "RMS [m]", "s.e.", "prototype"),
    *("better than fastslam1", "aligned RMS [m]", "better, aligned"),
    "of the mean: RMS, aligned",
)


class Study(NamedTuple):
    """The same drives through several filters."""

    drives: Simulated
    errors: dict[tuple[Name, int], WayError]
    """Of the heaviest particle, as in the paper."""
    means: dict[tuple[Name, int], WayError]
    """Of the mean of all."""


def drives_of(keys: jax.Array, landmarks: jax.Array) -> tuple[jax.Array, Simulated]:
    """The start, and a drive for each key past its landmarks."""
    start, controls = Circle().way(Car())
    one = lambda key, places: simulate(
        key, places, start, controls, Car(), RangeBearing()
    )
    return start, jax.jit(jax.vmap(one))(keys, landmarks)


def config_of(method: Name, particles: int) -> SlamConfig:
    """Told what is true, and which landmark is which."""
    return SlamConfig(
        method=method, particles=particles, landmarks=LANDMARKS, association=None
    )


def error(poses: Numbers, drives: Simulated) -> WayError:
    """Of each seed's way; the truth is the same for all."""
    times = np.arange(len(drives.poses[0]), dtype=float)
    fixes = np.column_stack([times, np.asarray(drives.poses[0])[:, :2]])
    return way_error(times, poses, fixes)


def study(options: Options, landmarks: jax.Array) -> Study:
    """All methods and numbers of particles; landmarks of each seed."""
    seeds = len(landmarks)
    start, drives = drives_of(jax.random.split(jax.random.key(1), seeds), landmarks)
    keys = jax.random.split(jax.random.key(2), seeds)
    errors, means = {}, {}
    for particles in options.particles:
        for method in options.methods:
            info = found(config_of(method, particles), start, keys, drives.drive).info
            errors[method, particles] = error(info.pose, drives)
            means[method, particles] = error(info.mean, drives)
    return Study(drives, errors, means)


def simulation(options: Options) -> Iterator[Table]:
    """Worlds of their own for every seed, one world for all, and what sharing costs."""
    seeds = QUICK_SEEDS if options.quick else options.seeds
    own = jax.vmap(scatter)(jax.random.split(jax.random.key(5), seeds))
    many = study(options, own)
    yield _table(f"Simulation, {seeds} worlds", many, options, prototype=False)
    yield _goals(many, options)
    same = QUICK_SEEDS if options.quick else FIXED_SEEDS
    world = jnp.broadcast_to(scatter(jax.random.key(0)), (same, LANDMARKS, 2))
    one = study(options, world)
    yield _table(f"Simulation, one world, {same} seeds", one, options, prototype=True)
    _draw(options, one, many)
    if not options.quick:
        yield _joint(options, many)


def _table(title: str, some: Study, options: Options, prototype: bool) -> Table:
    rows = []
    for particles in options.particles:
        first = some.errors["fastslam1", particles]
        for method in options.methods:
            now, mean = some.errors[method, particles], some.means[method, particles]
            theirs = PROTOTYPE.get(method, {}).get(particles) if prototype else None
            rows.append(
                (
                    *(str(particles), method, spread(now.rms), error_of(now.rms)),
                    "" if theirs is None else number(theirs),
                    _better(paired(now.rms, first.rms), method),
                    spread(now.aligned_rms),
                    _better(paired(now.aligned_rms, first.aligned_rms), method),
                    f"{np.mean(mean.rms):.3f}, {np.mean(mean.aligned_rms):.3f}",
                )
            )
    note = (
        "Known association. Mean ± deviation over seeds of each drive's RMS; every "
        "method sees the same drives. The prototype's one world was another."
    )
    return Table(title, HEAD, rows, note)


def _better(pair: Paired, method: str) -> str:
    return "" if method == "fastslam1" else gain(pair)


def _goals(some: Study, options: Options) -> Table:
    """The issue's, on worlds of their own."""
    pair = lambda ours, theirs, particles: paired(
        some.errors[ours, particles].rms, some.errors[theirs, particles].rms
    )
    rows = []
    for particles in options.particles:
        if options.quick or particles <= 10:
            now = pair("lslam", "fastslam1", particles)
            goal = f"lslam better than fastslam1 at {particles}, by 3 s.e."
            rows.append((goal, gain(now), verdict(now.sigmas >= 3)))
        else:
            now = pair("lslam", "fastslam2", particles)
            goal = f"lslam within 0.03 m of fastslam2 at {particles}"
            rows.append((goal, gain(now), verdict(abs(now.gain) <= 0.03)))
        if particles == 5 and "lslam2" in options.methods:
            now = pair("lslam2", "fastslam2", particles)
            goal = "lslam2 no worse than fastslam2 at 5, within 2 s.e."
            rows.append((goal, gain(now), verdict(now.sigmas > -2)))
    note = "Mean of the paired differences [m]; above 0 the first is better."
    return Table("Simulation: goals", ("goal", "difference", ""), rows, note)


def _joint(options: Options, many: Study) -> Table:
    """The same first seeds with all correlations kept."""
    seeds = min(JOINT_SEEDS, options.seeds)
    start, _ = Circle().way(Car())
    some = jax.tree.map(lambda a: a[:seeds], many.drives)
    keys = jax.random.split(jax.random.key(2), options.seeds)[:seeds]
    rows = []
    for method, particles in CORRELATED:
        seen = found(config_of(method, particles), start, keys, some.drive)
        now = error(seen.info.pose, some)
        beside = many.errors["lslam", max(5, particles)]
        rows.append(
            (
                *(method, str(particles), spread(now.rms)),
                gain(paired(now.rms, beside.rms[:seeds])),
                spread(now.aligned_rms),
                gain(paired(now.aligned_rms, beside.aligned_rms[:seeds])),
            )
        )
    head = ("method", "particles", "RMS [m]", "better than lslam", "aligned", "better")
    note = f"The first {seeds} of the worlds above; ekf against lslam with 5 particles."
    return Table("Simulation: all correlations kept", head, rows, note)


def _draw(options: Options, one: Study, many: Study) -> None:
    if options.out is None:
        return
    figure = Figure(figsize=(11, 4.2))
    panels = figure.subplots(1, 2, sharey=True)
    for ax, some, seeds in (
        (panels[0], one, PAPER_SEEDS),
        (panels[1], many, len(many.drives.poses)),
    ):
        curves = {
            method: [some.errors[method, p].rms[:seeds] for p in options.particles]
            for method in options.methods
        }
        plot_particle_errors(ax, options.particles, curves)
    panels[0].set_title(f"one world, {PAPER_SEEDS} seeds (the paper's figure 2b)")
    panels[1].set_title(f"{len(many.drives.poses)} worlds")
    panels[1].set_ylabel("")
    save(figure, options.out, "lslam_simulation")

    start, _ = Circle().way(Car())
    keys = jax.random.split(jax.random.key(2), len(one.drives.poses))
    config = config_of("lslam", options.particles[-1])
    seen = found(config, start, keys, one.drives.drive)  # compiled for these shapes
    first = jax.tree.map(lambda a: a[0], seen)
    world = np.asarray(scatter(jax.random.key(0)))
    truth = np.asarray(one.drives.poses)[0, :, :2]
    figure = Figure(figsize=(6, 6))
    plot_slam(figure.add_subplot(), first.info.pose, first.landmarks, truth, world)
    save(figure, options.out, "lslam_world")
