"""How far does the way stray that scans alone tell? Drift per metre, beside wheels.

    python scripts/bench_odometry.py                     # everything, ten to fifteen minutes
    python scripts/bench_odometry.py --only speed
    python scripts/bench_odometry.py --quick             # does it run at all?

In order:

- `logs`: whole recordings, the log's own wheel odometry and ours against reference
  poses, over sub-paths of 1, 2, 5, 10 and 20 m (`evaluation.drift`);
- `speed`: scans a second, a whole log as one program, compiling apart.

Recordings are looked for at ../shared/data, or where FSMSM_DATA points; without them
nothing is printed. One set of settings for all logs: the defaults.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from thesis.report import Table, find_folder, number, parser_of, print_sections
from tracking.recordings import CARMEN, MAC, MAEBOT, WEAN, Recording, load

from fsmsm_jax.evaluation.drift import Drift, drift, way
from fsmsm_jax.localisation import odometer
from fsmsm_jax.localisation.lidar_odometry import lidar_odometry

HEAD = (
    *("scans", "way [m]", "what", "drift [%]", "at 1 m", "longest", "[°/m]"),
    *("worst [%]", "worst [°/m]", "not matched", "keyframes", "scans/s"),
)
_QUICK = 200


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    quick: bool
    data: Path | None


def logs(options: Options) -> Iterator[Table]:
    """Every log, its wheels where it has them, and ours."""
    if options.data is None:
        return
    for name in (MAC, *CARMEN, *WEAN, MAEBOT):
        rows = []
        recording = _load(options, name)
        reference, log = recording.reference, recording.log
        scans = len(reference)
        known = np.isfinite(reference).all(axis=1)
        facts = str(scans), number(way(reference[known])[-1])
        if log.odometry is not None:
            found = drift(log.odometry[:scans], reference)
            rows.append((*facts, "wheels", *_drifts(found), *[""] * 3))
        begun = time.perf_counter()
        ours = lidar_odometry(log.scans(range(scans)))
        rate = scans / (time.perf_counter() - begun)
        lost = int(np.isin(ours.status, ("skipped", "doubted")).sum())
        kept = int((ours.status == "keyframe").sum())
        found = drift(ours.pose, reference)
        counts = str(lost), str(kept), number(rate)
        rows.append((*facts, "scans", *_drifts(found), *counts))
        yield Table(f"Drift on {name}", HEAD, rows, _note(name))


def _note(name: str) -> str:
    """What to think of a log's numbers."""
    lengths = "1, 2 and 5 m" if name in (MAC, MAEBOT) else "1, 2, 5, 10 and 20 m"
    cm = "a decimetre" if name in WEAN else "some cm"
    return (
        f"Mean over sub-paths of {lengths}; references err by {cm} themselves. Scans a "
        "second with compiling."
    )


def _drifts(found: Drift) -> tuple[str, ...]:
    """Means over all lengths, the shortest and the longest, and the worst."""
    if not len(found.length):
        return ("",) * 6
    metres, radians = found.mean()
    ends = [found.mean(found.wanted.min())[0], found.mean(found.wanted.max())[0]]
    worst, most = found.worst()
    percent = [number(100 * share) for share in (metres, *ends)]
    turns = [number(np.rad2deg(angle)) for angle in (radians, most)]
    return *percent, turns[0], number(100 * worst), turns[1]


def speed(options: Options) -> Iterator[Table]:
    """A whole log in one `lax.scan`, warm."""
    if options.data is None:
        return
    rows = []
    for name in (MAC, "intel", "freiburg-079"):
        recording = _load(options, name).upto(300 if options.quick else 2000)
        scans = recording.log.scans(range(len(recording.reference)))
        times = []
        for _ in range(4):
            begun = time.perf_counter()
            jax.block_until_ready(odometer.run(odometer.init(), scans))
            times.append(time.perf_counter() - begun)
        count, rays = scans.ranges.shape
        best, middle = min(times[1:]), float(np.median(times[1:]))
        rates = number(count / middle), number(count / best)
        rows.append((name, str(rays), str(count), *rates, number(times[0] - middle)))
    head = ("log", "rays", "scans", "scans/s, median of 3", "best", "compiling [s]")
    yield Table("Scans a second", head, rows, "Begun at rest; nothing else computed.")


def _load(options: Options, name: str) -> Recording:
    assert options.data is not None
    recording = load(options.data, name)
    return recording.upto(_QUICK) if options.quick else recording


SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "logs": logs,
    "speed": speed,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(given.quick, find_folder("FSMSM_DATA", "data"))
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
