"""Longer roads: Victoria Park, 4 km among trees, and a robot among barcodes."""

from collections.abc import Iterator
from dataclasses import replace

import jax
import numpy as np
from matplotlib.figure import Figure
from thesis.report import Table, number, save

from fsmsm_jax.evaluation.slam import map_error, moved, way_error
from fsmsm_jax.io.acfr import read_victoria_park
from fsmsm_jax.io.landmarks import LandmarkLog
from fsmsm_jax.io.mrclam import read_mrclam
from fsmsm_jax.plotting.slam import plot_slam
from fsmsm_jax.slam.association import Association
from fsmsm_jax.slam.filter import SlamConfig
from fsmsm_jax.slam.methods import Name
from lslam.runs import METHODS, Found, Options, found, spread

SLOTS = 768
RULES = Association(missed=0.1)
MENDED = (1.036, 0.0055)
ASKED: tuple[tuple[Name, int, tuple[float, float]], ...] = (
    ("lslam2", 20, MENDED),
    ("lslam2", 20, (1.0, 0.0)),
    ("lslam", 20, MENDED),
)
MRCLAM_SECONDS, MRCLAM_SEEDS = 700.0, 20


def victoria(options: Options) -> Iterator[Table]:
    """Each run takes minutes: one seed."""
    if options.data is None or not (options.data / "slam" / "victoria_park").is_dir():
        return
    folder = options.data / "slam" / "victoria_park"
    log = read_victoria_park(folder, 120.0 if options.quick else np.inf)
    rows = []
    for method, particles, trim in ASKED[: 1 if options.quick else None]:
        config = SlamConfig(
            method=method,
            particles=particles,
            landmarks=SLOTS,
            vehicle=replace(log.vehicle, trim=trim),
            sensor=log.sensor,
            association=RULES,
        )
        keys = jax.random.split(jax.random.key(0), 1)
        seen = found(config, log.start, keys, log.drive)
        rows.append(_park_row(log, config, trim == MENDED, seen))
        if method == "lslam2" and trim == MENDED:
            _draw_park(options, log, seen, particles)
    head = (
        *("method", "particles", "steering", "median [m]", "RMS", "95 %"),
        *("aligned: median", "RMS", "map", "no slot", "finite"),
    )
    note = (
        f"To GPS, {len(log.reference)} fixes, some of which jump by up to 140 m: read "
        "the medians. Association unknown, one seed, lslam2 is the picture."
    )
    yield Table("Victoria Park", head, rows, note)


def _park_row(
    log: LandmarkLog, config: SlamConfig, mended: bool, seen: Found
) -> tuple[str, ...]:
    way = way_error(log.times, seen.info.pose[0], log.reference)
    told = "mended" if mended else "as read"
    return (
        *(config.method, str(config.particles), told),
        *map(number, (np.median(way.distance), way.rms)),
        number(np.percentile(way.distance, 95)),
        *map(number, (np.median(way.aligned), way.aligned_rms)),
        str(seen.info.known[0, -1]),
        str(seen.info.unplaced.sum()),
        "yes" if np.isfinite(seen.info.pose).all() else "NO",
    )


def _draw_park(options: Options, log: LandmarkLog, seen: Found, particles: int) -> None:
    if options.out is None:
        return
    first = jax.tree.map(lambda a: a[0], seen)
    figure = Figure(figsize=(8, 8))
    ax = figure.add_subplot()
    plot_slam(ax, first.info.pose, first.landmarks, log.reference[:, 1:])
    save(figure, options.out, f"lslam_victoria_{particles}")


def mrclam(options: Options) -> Iterator[Table]:
    """Barcodes say which is which; the first 700 s, before motion capture errs."""
    if options.data is None or not (options.data / "slam" / "utias_mrclam9").is_dir():
        return
    log = read_mrclam(options.data / "slam" / "utias_mrclam9")
    surveyed = np.asarray(log.landmarks)
    upto = np.searchsorted(
        log.times, log.times[0] + (60 if options.quick else MRCLAM_SECONDS)
    )
    drive = jax.tree.map(lambda a: a[:upto], log.drive)
    keys = jax.random.split(jax.random.key(0), 2 if options.quick else MRCLAM_SEEDS)
    rows = []
    for method in METHODS:
        config = SlamConfig(
            method=method,
            particles=20,
            landmarks=len(surveyed),
            vehicle=log.vehicle,
            sensor=log.sensor,
            association=None,
        )
        seen = found(config, log.start, keys, drive)
        way = way_error(log.times[:upto], seen.info.pose, log.reference)
        survey = [
            map_error(moved(way.gauge[n], place[there]), surveyed).rms
            for n, (place, there) in enumerate(
                zip(
                    np.stack([*seen.landmarks.place], axis=-1),
                    np.asarray(seen.landmarks.known),
                    strict=True,
                )
            )
        ]
        rows.append(
            (method, spread(way.rms), spread(way.aligned_rms), spread(np.array(survey)))
        )
    note = (
        f"Robot 3 of set 9, the first {MRCLAM_SECONDS:.0f} s, against motion capture; "
        f"20 particles, {len(keys)} seeds, association known."
    )
    head = ("method", "RMS [m]", "aligned RMS [m]", "survey, aligned RMS [m]")
    yield Table("MRCLAM", head, rows, note)
