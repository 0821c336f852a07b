"""Tracked from start to end? The numbers that the tracker is held to.

    python scripts/bench_tracking.py                     # everything, a quarter of an hour
    python scripts/bench_tracking.py --only logs
    python scripts/bench_tracking.py --quick             # does it run at all?

In order:

- `logs`: whole recordings, with odometry and without, against their reference poses;
- `kidnap`: recordings spliced at random, and false alarms in those that are not;
- `steps`: milliseconds a step;
- `amcl`: the same log with the PyPI package `amcl`, if it is installed.

Recordings are looked for at ../shared/data, or where FSMSM_DATA points; without them
nothing is printed. The particle filter has `reproduce_particles.py`.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from thesis.report import Table, find_folder, parser_of, print_sections
from tracking import kidnap, logs, speed


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    splices: int
    quick: bool
    data: Path | None


SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "logs": logs.tables,
    "kidnap": kidnap.tables,
    "steps": speed.steps,
    "amcl": speed.amcl,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--splices", type=int, default=25, metavar="N", help="of a log (default: 25)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    data = find_folder("FSMSM_DATA", "data")
    options = Options(given.splices, given.quick, data)
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
