"""A robot that is carried away: logs spliced at random, and logs that are not."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from thesis.report import Table, number, percent

from fsmsm_jax import ScanAtlas
from fsmsm_jax.evaluation import share_of
from fsmsm_jax.io.frames import between, chain
from fsmsm_jax.localisation.follow import follow
from fsmsm_jax.localisation.track import Track, stacked
from tracking.logs import timed_track
from tracking.recordings import CARMEN, MAC, WEAN, Recording, load

BEFORE, AFTER = 20, 60  # scans on either side of the splice
IN_TIME = 3  # scans in which a kidnap should be noticed
FAR = 2.0  # [m] that the robot is carried at least
RIGHT = 0.5, np.deg2rad(10)  # [m], [rad]


class Kidnap(NamedTuple):
    """What became of one splice."""

    noticed: int
    """How many scans it took; 0 if it was never noticed."""
    recovered: bool
    """Whether tracking ended in the right place."""
    scans_lost: int
    """Scans that were said to be lost."""


def splice(
    recording: Recording,
    atlas: ScanAtlas,
    truth: np.ndarray,
    taken: int,
    put: int,
) -> Kidnap:
    """Track up to scan `taken`, and go on with scan `put`; odometry notices nothing."""
    rows = np.r_[taken - BEFORE : taken, put : put + AFTER]
    odometry = recording.log.odometry
    if odometry is not None:
        motions = between(odometry[rows - 1], odometry[rows])
        # While it was carried, the robot thinks, it drove on as in the scan before.
        motions[BEFORE] = motions[BEFORE - 1]
        odometry = chain(odometry[rows[0]], motions[1:])
    readings = stacked(recording.log.scans(rows), odometry)
    track = Track.of(list(follow(atlas, readings, truth[rows[0]])))
    after = track.status[BEFORE:]
    noticed = np.flatnonzero(np.isin(after, ["lost", "localised"]))
    off = track.pose[-1] - truth[rows[-1]]
    turn = abs(float(np.mod(off[2] + np.pi, 2 * np.pi) - np.pi))
    return Kidnap(
        noticed=int(noticed[0]) + 1 if noticed.size else 0,
        recovered=bool(
            np.hypot(off[0], off[1]) < RIGHT[0]
            and turn < RIGHT[1]
            and track.status[-1] != "lost"
        ),
        scans_lost=int(np.sum(after == "lost")),
    )


def tables(options) -> Iterator[Table]:
    """Splices log by log, and how often an unspliced log is taken for one."""
    if options.data is None:
        return
    rng = np.random.default_rng(0)
    names = (MAC,) if options.quick else (MAC, *CARMEN, WEAN[1])
    rows, alarms, every = [], [], []
    for name in names:
        recording = load(options.data, name)
        atlas, first = recording.atlas(), int(recording.scored[0])
        initial = recording.reference[first]
        whole, _ = timed_track(recording, atlas, initial=initial, first=first)
        missing = np.full((first, 3), np.nan)
        truth = np.concatenate([missing, whole.pose])
        lost = np.isin(whole.status, ["lost", "localised"])
        doubted = np.sum(whole.status == "doubted")
        alarms.append(
            (
                *(name, str(len(whole.pose)), str(int(np.sum(lost)))),
                *(str(int(np.sum(lost & ~np.roll(lost, 1)))), str(int(doubted))),
            )
        )

        last = len(truth) - AFTER
        done: list[Kidnap] = []
        while len(done) < (2 if options.quick else options.splices):
            taken, put = rng.integers(first + BEFORE + 1, last, 2)
            away = np.hypot(*(truth[taken] - truth[put])[:2])
            if away > FAR:
                done.append(splice(recording, atlas, truth, int(taken), int(put)))
        rows.append((name, str(len(done)), *_counted(done)))
        every += done if name not in WEAN else []
    rows.append(("all but wean", str(len(every)), *_counted(every)))
    head = (
        *("log", "splices", "noticed in 3 scans [%]", "found again, right [%]"),
        *("scans to notice, median", "scans lost, median"),
    )
    note = (
        f"The robot is carried at least {FAR:g} m; {AFTER} scans later it should track "
        "the place where the whole log, tracked, says it is. Brackets: 95 %."
    )
    yield Table("Kidnapped", head, rows, note)
    yield Table(
        "False alarms in whole logs",
        ("log", "scans", "called lost or localised anew", "times", "doubted"),
        alarms,
    )


def _counted(done):
    noticed = np.array([0 < one.noticed <= IN_TIME for one in done])
    recovered = np.array([one.recovered for one in done])
    return (
        percent(share_of(noticed)),
        percent(share_of(recovered)),
        number(np.median([one.noticed for one in done])),
        number(np.median([one.scans_lost for one in done])),
    )
