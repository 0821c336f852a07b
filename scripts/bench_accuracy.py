"""How accurate, how sure and how fast? The numbers that `match` is held to.

    python scripts/bench_accuracy.py                     # everything, half an hour
    python scripts/bench_accuracy.py --only polygons grids --worlds 200
    python scripts/bench_accuracy.py --quick             # does it run at all?

In order:

- `polygons`: errors against the Cramér–Rao bound in 1000 of the thesis's worlds, NEES,
  wrong basins, and the same with noise in the map;
- `grids`: the same in a generated office of 5 cm cells;
- `speed`: milliseconds a match beside the author's C++;
- `gl`: three big maps with cases that others were measured on;
- `consistency`: NEES in simulation and on real scans;
- `mounting`: a real robot's lidar, calibrated from 20° off;
- `people`: does a kernel that expects people help where there are some?

Recordings are looked for at ../shared/data, or where FSMSM_DATA points; sections that
need them are left out without.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from accuracy import consistency, efficiency, mounting, speed, wean
from reproduce_thesis import folder
from thesis.report import Table, circumstances
from thesis.worlds import Options

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "polygons": efficiency.polygons,
    "grids": efficiency.grids,
    "speed": speed.speed,
    "gl": speed.gl,
    "consistency": consistency.tables,
    "mounting": mounting.tables,
    "people": wean.tables,
}


def main() -> None:
    summary, _, details = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=summary,
        epilog=details,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--worlds", type=int, default=1000, metavar="N", help="cases (default: 1000)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        worlds=20 if given.quick else given.worlds,
        quick=given.quick,
        data=folder("FSMSM_DATA", "data"),
    )
    facts = [f"{key:9} {value}" for key, value in circumstances().items()]
    print("\n".join(facts), "\n", flush=True)
    document = ["```", *facts, "```", ""]
    for name in given.only or SECTIONS:
        start = time.perf_counter()
        for table in SECTIONS[name](options):
            print(table.text(), flush=True)
            document.append(table.markdown())
        print(f"... {name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
        if given.markdown:
            given.markdown.write_text("\n".join(document))


if __name__ == "__main__":
    main()
