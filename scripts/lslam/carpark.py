"""Figure 3b: the ACFR's car park, where nobody says which pole is which."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from thesis.report import Table, save

from fsmsm_jax.evaluation.estimates import paired
from fsmsm_jax.evaluation.slam import WayError, map_error, moved, way_error
from fsmsm_jax.io.acfr import read_carpark
from fsmsm_jax.io.landmarks import LandmarkLog
from fsmsm_jax.plotting.slam import plot_particle_errors, plot_slam
from fsmsm_jax.slam.association import Association
from fsmsm_jax.slam.filter import SlamConfig
from fsmsm_jax.slam.methods import Name
from lslam.runs import METHODS, Found, Options, found, gain, spread, verdict

SEEDS, SLOTS = 20, 60
MENDED = (1.02, 0.0063)  # what the steering should have said: see `io.acfr`
HEAD = (
    *("particles", "method", "RMS to GPS [m]", "better than fastslam1"),
    *("aligned RMS [m]", "map (true 15)", "survey RMS [m]", "missing / extra"),
)


class Setting(NamedTuple):
    """What the filters are told."""

    title: str
    vehicle: dict
    sensor: dict
    note: str = ""


READ = Setting("as read", {}, {}, "Noise of the ACFR's own filter: 0.7 m/s, 7°.")
SETTINGS = (
    READ,
    Setting(
        *("steering mended", {"trim": MENDED}, {}),
        "The same, and the steering's bias told: 2 %, 0.0063 rad.",
    ),
    Setting(
        *("the paper's noise", {"noise": (0.4, 0.05)}, {"noise": (0.1, 0.01)}),
        "0.4 m/s and 0.05 rad, where the steering is 0.15 rad wrong as if drawn afresh.",
    ),
    Setting(
        *("steering trusted", {"noise": (0.7, 0.05)}, {}),
        "As read, but 0.05 rad of steering: is it the laser's noise or the steering's?",
    ),
)


class Cell(NamedTuple):
    """One filter, all seeds."""

    way: WayError
    size: np.ndarray
    """Landmarks at the end."""
    survey: np.ndarray
    """RMS of landmarks against the surveyed poles, aligned as the way [m]."""
    missing: np.ndarray
    extra: np.ndarray


def carpark(options: Options) -> Iterator[Table]:
    """Four settings; the goals are judged on the first two."""
    if options.data is None or not (options.data / "slam" / "carpark").is_dir():
        return
    log = read_carpark(options.data / "slam" / "carpark")
    for setting in SETTINGS[: 1 if options.quick else None]:
        cells = _cells(options, log, setting)
        yield _table(options, setting, cells)
        if setting in SETTINGS[:2]:
            yield _goals(options, setting, cells)
            _draw_errors(options, setting, cells)
    _draw_map(options, log)


def _config(log: LandmarkLog, setting: Setting, method: Name, particles: int):
    return SlamConfig(
        method=method,
        particles=particles,
        landmarks=SLOTS,
        vehicle=replace(log.vehicle, **setting.vehicle),
        sensor=replace(log.sensor, **setting.sensor),
        association=Association(),
    )


def _cells(options: Options, log: LandmarkLog, setting: Setting):
    keys = jax.random.split(jax.random.key(3), 4 if options.quick else SEEDS)
    return {
        (method, particles): _judged(
            log,
            found(_config(log, setting, method, particles), log.start, keys, log.drive),
        )
        for particles in options.particles
        for method in options.methods
    }


def _judged(log: LandmarkLog, seen: Found) -> Cell:
    way = way_error(log.times, seen.info.pose, log.reference)
    known = np.asarray(seen.landmarks.known)
    places = np.stack([*seen.landmarks.place], axis=-1)
    maps = [
        map_error(moved(gauge, place[there]), np.asarray(log.landmarks))
        for gauge, place, there in zip(way.gauge, places, known, strict=True)
    ]
    column = lambda name: np.array([getattr(one, name) for one in maps])
    return Cell(way, known.sum(-1), column("rms"), column("missing"), column("extra"))


def _table(options: Options, setting: Setting, cells) -> Table:
    rows = []
    for (method, particles), now in cells.items():
        first = cells["fastslam1", particles].way
        better = "" if method == "fastslam1" else gain(paired(now.way.rms, first.rms))
        rows.append(
            (
                *(str(particles), method, spread(now.way.rms), better),
                spread(now.way.aligned_rms),
                f"{now.size.mean():.1f} ± {now.size.std():.1f}",
                f"{np.nanmean(now.survey):.3f}",
                f"{now.missing.mean():.1f} / {now.extra.mean():.1f}",
            )
        )
    seeds = len(next(iter(cells.values())).size)
    note = f"{setting.note} Association unknown, {seeds} seeds."
    return Table(f"Car park, {setting.title}", HEAD, rows, note)


def _goals(options: Options, setting: Setting, cells) -> Table:
    rows = []
    for particles in options.particles:
        for ours, theirs in (
            *(("lslam", "fastslam1"), ("fastslam2", "fastslam1")),
            *(("lslam2", "fastslam2"),) * (particles == 5),
        ):
            if {(ours, particles), (theirs, particles)} <= cells.keys():
                now = paired(
                    cells[ours, particles].way.rms, cells[theirs, particles].way.rms
                )
                goal = f"{ours} below {theirs} at {particles}"
                rows.append((goal, gain(now), verdict(now.gain > 0)))
    for method in METHODS:
        if (method, 40) in cells:
            size = cells[method, 40].size
            met = verdict(abs(size.mean() - 15) < 0.5)
            rows.append((f"15 landmarks at 40: {method}", spread(size), met))
    head = ("goal", "mean difference [m], or size", "")
    return Table(f"Car park, {setting.title}: goals", head, rows)


def _draw_errors(options: Options, setting: Setting, cells) -> None:
    if options.out is None:
        return
    figure = Figure(figsize=(11, 4.2))
    panels = figure.subplots(1, 2)
    methods = dict.fromkeys(method for method, _ in cells)
    for ax, name, title in (
        (panels[0], "rms", "to GPS (the paper's figure 3b)"),
        (panels[1], "aligned_rms", "aligned"),
    ):
        errors = {
            method: [getattr(cells[method, p].way, name) for p in options.particles]
            for method in methods
        }
        plot_particle_errors(ax, options.particles, errors)
        ax.set_title(f"car park, {setting.title}: {title}")
    save(figure, options.out, f"lslam_carpark_{setting.title.replace(' ', '_')}")


def _draw_map(options: Options, log: LandmarkLog) -> None:
    """Figure 3a: the last number of particles, the first seed."""
    if options.out is None:
        return
    config = _config(log, READ, options.methods[-1], options.particles[-1])
    keys = jax.random.split(jax.random.key(3), 4 if options.quick else SEEDS)
    seen = found(config, log.start, keys, log.drive)
    first = jax.tree.map(lambda a: a[0], seen)
    figure = Figure(figsize=(6, 6))
    fixes, poles = log.reference[:, 1:], log.landmarks
    plot_slam(figure.add_subplot(), first.info.pose, first.landmarks, fixes, poles)
    save(figure, options.out, "lslam_carpark_map")
