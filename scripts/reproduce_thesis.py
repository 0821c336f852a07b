"""Does it reproduce the thesis? Prints what chapter 6 publishes beside what comes out.

    python scripts/reproduce_thesis.py --out pictures          # everything, an hour
    python scripts/reproduce_thesis.py --only main --worlds 400
    python scripts/reproduce_thesis.py --quick                 # does it run at all?

In order:

- `main`: position and orientation errors, success and cost of the three published
  methods and of ours, over five recordings and ten levels of noise (§6.5);
- `golden`: the author's C++ on the same cases, case by case;
- `orientation`, `position`, `pairs`: the stages on their own (§6.2, §6.3);
- `degrees`: the largest sampling degree (§6.3); `range`: a shorter reach (§6.6);
- `time`: milliseconds a match, alone and in batches.

Recordings are looked for at ../shared/data, or where FSMSM_DATA points, the C++'s
results at ../shared/golden, or where FSMSM_GOLDEN points. Without recordings, worlds
are made out of generated offices, and the tables say so; nothing published holds there.
Everything is drawn from fixed keys: the same command gives the same numbers, up to the
clock's.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

from thesis import dials, judges, main_table, program, stages
from thesis.report import Table, find_folder, parser_of, print_sections
from thesis.worlds import NAMES, Options

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "main": main_table.main,
    "golden": program.golden,
    "orientation": stages.orientation,
    "position": stages.position,
    "pairs": judges.pairs,
    "degrees": dials.degrees,
    "range": dials.range_limits,
    "time": dials.times,
}
QUICK_WORLDS, QUICK_PAIRS = 10, 1000


def main() -> None:
    arguments = parse()
    options = Options(
        worlds=arguments.worlds or (QUICK_WORLDS if arguments.quick else 2000),
        pairs=arguments.pairs or (QUICK_PAIRS if arguments.quick else 1_000_000),
        quick=arguments.quick,
        out=arguments.out,
        data=find_folder("FSMSM_DATA", "data"),
        golden=find_folder("FSMSM_GOLDEN", "golden"),
        methods=tuple(arguments.methods),
    )
    print_sections(SECTIONS, arguments.only, options, arguments.markdown)


def parse() -> argparse.Namespace:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add(
        "--methods",
        nargs="+",
        choices=NAMES,
        default=NAMES,
        metavar="NAME",
        help=f"of main and golden (default: {' '.join(NAMES)})",
    )
    add("--worlds", type=positive, metavar="N", help="cases in all (default: 2000)")
    add("--pairs", type=positive, metavar="N", help="CAER pairs (default: 1000000)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--out", type=Path, metavar="FOLDER", help="write pictures there")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    return parser.parse_args()


def positive(text: str) -> int:
    """A whole number of at least one."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


if __name__ == "__main__":
    main()
