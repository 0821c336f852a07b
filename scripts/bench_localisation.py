"""How good is it? Prints the goals of this project beside what is measured here.

    python scripts/bench_localisation.py                    # everything, some 10 min
    python scripts/bench_localisation.py --only mac_final   # the rows mac_final/...
    python scripts/bench_localisation.py --quick --gate     # CI: no worse than before

The part of a key before the slash is what `--only` takes, so each row says how to
measure it again. Recordings are looked for at ../shared/data, or where FSMSM_DATA
points; without them only the made-up office and campus are measured. In order:

- `office`: scans simulated in a procedural building, a third of the rays blocked;
- real honest splits: the map knows nothing of the visit that is localised;
- simulated scans in big maps, beside the Cramér–Rao bound and CBGL's results;
- `infinite-corridor`: a real campus of long equal corridors, 232 m × 198 m;
- `pruning`: what is ruled out before the search, and whether the right place was;
- `campus`: a made-up one of 100 000 m², and what it costs against smaller ones;
- `devices`: a query by eight devices of this machine against one by one of them;
- `off_map`: scans of one building on the map of another, never to be believed;
- `atlas` (each in a process of its own), `batch` and `raycast`.

Right is < 0.3 m and < 5° (simulated: < 0.5 m); sure but wrong is `confident` and not
right; errors are medians of the right answers. Times are medians after a warm-up; the
first call, compilation included, has rows of its own. Machines differ and are shared,
so the gate looks at no seconds but at ratios to a fixed reference workload that is
timed in between.
"""

import argparse
import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
from localisation.campus import campus
from localisation.cost import batch, cold_atlas, raycast_throughput
from localisation.devices import devices
from localisation.pruning import pruning
from localisation.sections import (
    infinite_corridor,
    off_map,
    office,
    real,
    simulated,
)
from localisation.sets import Options
from localisation.table import line, markdown
from thesis.report import find_folder, parser_of

from fsmsm_jax.benchmark import (
    Metric,
    circumstances,
    read_record,
    regressions,
    write_record,
)

BASELINE = Path(__file__).with_name("baseline_localisation.json")
QUICK_SECTIONS, QUICK_SCANS = ("office", "intel_first60"), 40
MADE_UP = ("office", "campus")  # need no recordings

partial = functools.partial
SECTIONS: dict[str, Callable[[Options], Iterator[Metric]]] = {
    "office": office,
    "mac_9_23": partial(real, "mac_9_23", right=99, precise=True),
    "mac_final": partial(real, "mac_final", right=99, precise=True),
    "intel_first60": partial(real, "intel_first60", right=99, precise=True, query=60),
    "freiburg-079_first60": partial(real, "freiburg-079_first60", right=92),
    "csail_first60": partial(real, "csail_first60", right=95),
    "cbgl_willow": partial(simulated, "cbgl_willow", right=100, query=120),
    "cbgl_warehouse": partial(simulated, "cbgl_warehouse", right=100),
    "basement_5cm": partial(simulated, "basement_5cm", right=98),
    "infinite-corridor": infinite_corridor,
    "pruning": pruning,
    "campus": campus,
    "devices": devices,
    "off_map": off_map,
    "atlas": cold_atlas,
    "batch": batch,
    "raycast": raycast_throughput,
}


def main() -> int:
    arguments = parse()
    data = find_folder("FSMSM_DATA", "data")
    names = arguments.only or (QUICK_SECTIONS if arguments.quick else tuple(SECTIONS))
    if data is None:
        left_out = [name for name in names if name not in MADE_UP]
        names = [name for name in names if name in MADE_UP]
        print(f"no recordings, so without: {', '.join(left_out)}", file=sys.stderr)
    if not arguments.quick:  # the rows of first calls are about compiling
        jax.config.update("jax_enable_compilation_cache", False)

    limit = arguments.limit or (QUICK_SCANS if arguments.quick else None)
    print("\n".join(f"{k:9} {v}" for k, v in circumstances().items()), "\n", flush=True)
    rows = []
    for name in names:
        for row in SECTIONS[name](Options(data, limit)):
            rows.append(row)
            print(line(row), flush=True)
    goals = [row.met for row in rows if row.goal is not None]
    print(f"\n{sum(map(bool, goals))} of {len(goals)} goals met")

    if arguments.markdown:
        print(f"\n{markdown(rows)}")
    if arguments.json:
        write_record(arguments.json, rows)
    if arguments.write_baseline:
        write_record(BASELINE, rows)
    return gate(rows) if arguments.gate else 0


def gate(rows: Sequence[Metric]) -> int:
    """Say what got worse; the exit status."""
    worse = regressions(rows, read_record(BASELINE).rows)
    print("\n".join(f"REGRESSION {text}" for text in worse) or "no regressions")
    return 1 if worse else 0


def parse() -> argparse.Namespace:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="office and 40 intel scans: minutes")
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--limit", type=int, metavar="N", help="only the first N scans of each set")
    add("--json", type=Path, metavar="FILE", help="write all rows there")
    add("--markdown", action="store_true", help="print the table for the README")
    either = parser.add_mutually_exclusive_group().add_argument
    either("--gate", action="store_true", help="exit 1 if worse than the baseline")
    either("--write-baseline", action="store_true", help=f"write {BASELINE.name}")
    arguments = parser.parse_args()
    if arguments.limit is not None and arguments.limit < 1:
        parser.error("--limit must be 1 or more")
    baseline = arguments.gate or arguments.write_baseline
    if baseline and (not arguments.quick or arguments.only or arguments.limit):
        parser.error("the baseline is that of --quick, without --only and --limit")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
