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
- `references`: how good the reference poses of those scans are;
- `mounting`: a real robot's lidar, calibrated from 20° off;
- `people`: does a kernel that expects people help where there are some?

Recordings are looked for at ../shared/data, or where FSMSM_DATA points; sections that
need them are left out without.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from accuracy import consistency, efficiency, mounting, references, speed, wean
from thesis.report import Table, find_folder, parser_of, print_sections
from thesis.worlds import Options

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "polygons": efficiency.polygons,
    "grids": efficiency.grids,
    "speed": speed.speed,
    "gl": speed.gl,
    "consistency": consistency.tables,
    "references": references.tables,
    "mounting": mounting.tables,
    "people": wean.tables,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--worlds", type=int, default=1000, metavar="N", help="cases (default: 1000)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        worlds=20 if given.quick else given.worlds,
        quick=given.quick,
        data=find_folder("FSMSM_DATA", "data"),
    )
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
