"""Whole logs from start to end: lost, how far off, how long a step takes."""

import time
from collections.abc import Iterator

import numpy as np
from thesis.report import Table, number

from fsmsm_jax.localisation.follow import follow
from fsmsm_jax.localisation.track import Track, stacked
from tracking.recordings import CARMEN, MAC, MAEBOT, WEAN, Recording, load, verdict

HEAD = (
    *("log", "start", "scans", "lost after the start", "wrong unawares"),
    *("median [cm]", "p95", "p99", "median [°]", "a scan [ms]: median", "p99"),
)
_QUICK = 150


def timed_track(
    recording: Recording,
    atlas,
    *,
    initial=None,
    odometry: bool = True,
    moments=None,
    first: int = 0,
) -> tuple[Track, np.ndarray]:
    """Fixes of a log from one scan on, and the seconds of each."""
    log, upto = recording.log, len(recording.reference)
    rows = np.arange(first, upto)
    counted = log.odometry[rows] if odometry and log.odometry is not None else None
    when = moments[rows] if moments is not None else None
    fixes, seconds = [], []
    readings = follow(atlas, stacked(log.scans(rows), counted, when), initial)
    begun = time.perf_counter()
    for fix in readings:
        fixes.append(fix)
        now = time.perf_counter()
        seconds.append(now - begun)
        begun = now
    return Track.of(fixes), np.array(seconds)


def _row(recording, atlas, start, **how):
    track, seconds = timed_track(recording, atlas, **how)
    first = how.get("first", 0)
    here = recording._replace(
        reference=recording.reference[first:],
        scored=recording.scored[recording.scored >= first] - first,
    )
    # The first scan compiles, and a robot that is lost compiles again.
    steps = seconds[(track.status == "tracking") & (seconds < 1.0)]
    times = np.percentile(1e3 * steps, [50, 99])
    return (
        *(recording.name, start, str(len(track.pose))),
        *verdict(here, track),
        *(number(t) for t in times),
    )


def tables(options) -> Iterator[Table]:
    """Every log, from an unknown start where the map is good enough for that."""
    if options.data is None:
        return
    rows = []
    for name in (MAC, *CARMEN):
        recording = _load(options, name)
        atlas = recording.atlas()
        first = recording.scored[0] if name in CARMEN else 0
        rows.append(_row(recording, atlas, "unknown", first=first))
        if name in (MAC, "intel"):
            how = dict(odometry=False, first=first)
            rows.append(_row(recording, atlas, "unknown, no odometry", **how))
    recording = _load(options, MAEBOT)
    atlas, given = recording.atlas(), recording.scored[0]
    how = dict(initial=recording.reference[given], first=given)
    rows.append(_row(recording, atlas, "given, no odometry", **how))
    how |= dict(moments=recording.moments())
    rows.append(_row(recording, atlas, "the same, compensated", **how))
    for name in WEAN:
        recording = _load(options, name)
        initial = recording.reference[0]
        rows.append(_row(recording, recording.atlas(), "given", initial=initial))
    note = (
        "Errors against the reference where the map was not built from the scan; wrong "
        "is over 0.5 m or 10° and not said to be lost. Logs whose first scans have no "
        "reference begin with the first that is judged."
    )
    yield Table("Whole logs", HEAD, rows, note)


def _load(options, name):
    recording = load(options.data, name)
    return recording.upto(_first(recording) + _QUICK) if options.quick else recording


def _first(recording):
    return int(recording.scored[0])
