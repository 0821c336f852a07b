"""Images instead of ranges: the thesis's chapter 5, Fourier-Mellin registration.

    python scripts/reproduce_fmi.py                      # everything, an hour
    python scripts/reproduce_fmi.py --only global --runs 2
    python scripts/reproduce_fmi.py --quick              # does it run at all?

In order:

- `images`: registration of pictures turned, magnified, shifted and spoilt;
- `global`: one scan in a whole map by pictures of scans (PGL-FMIC), in the thesis's
  worlds, beside what it printed and beside `localise`.

Maps are looked for at ../shared/data, or where FSMSM_DATA points; without them a
generated office stands in.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from fmi import global_localisation, images
from fmi.global_localisation import Options
from thesis.report import Table, find_folder, parser_of, print_sections

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "images": images.tables,
    "global": global_localisation.tables,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    runs = "times the published number of poses (default: 4)"
    add("--runs", type=int, default=4, metavar="N", help=runs)
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        runs=1 if given.quick else given.runs,
        quick=given.quick,
        data=find_folder("FSMSM_DATA", "data"),
    )
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
