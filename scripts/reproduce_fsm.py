"""Does scan against scan do what chapter 7 says? The published numbers beside ours.

    python scripts/reproduce_fsm.py                     # everything, half an hour
    python scripts/reproduce_fsm.py --only golden
    python scripts/reproduce_fsm.py --quick             # does it run at all?

In order:

- `golden`: the author's C++ on the same 778 pairs, case by case, and its time;
- `protocol`: six displacements, five levels of noise, beside the thesis's tables;
- `time`: milliseconds a match, alone and in a batch.

Recordings are looked for at ../shared/data, or where FSMSM_DATA points, the C++'s
results at ../shared/golden, or where FSMSM_GOLDEN points. Without recordings, worlds
are made out of generated offices, and the tables say so; nothing published holds there.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from fsm import program, protocol
from thesis.report import Table, find_folder, parser_of, print_sections
from thesis.worlds import Options

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "golden": program.golden,
    "protocol": protocol.protocol,
    "time": program.times,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--worlds", type=int, metavar="N", help="pairs a cell (default: 2000)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        worlds=given.worlds or (20 if given.quick else 2000),
        quick=given.quick,
        data=find_folder("FSMSM_DATA", "data"),
        golden=find_folder("FSMSM_GOLDEN", "golden"),
    )
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
