"""Monte Carlo localisation with scan matching: the thesis's chapter 4, in simulation.

    python scripts/reproduce_particles.py                     # everything, an hour or two
    python scripts/reproduce_particles.py --only corridor --seeds 20
    python scripts/reproduce_particles.py --quick             # does it run at all?

In order:

- `corridor`, `warehouse`: the thesis's two worlds: which particles should be the
  output, what scan matching adds to it, and whether the filter should be told;
- `speed`: updates a second, and the number of particles as the filter settles;
- `global`: begin without a prior, by the atlas and by brute force.

The thesis drove a robot in Gazebo; here it is a simulated differential drive on the
same maps. Maps are looked for at ../shared/data, or where FSMSM_DATA points; sections
that need them are left out without.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from particles import filters, navigation
from particles.navigation import Options
from thesis.report import Table, find_folder, parser_of, print_sections

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "corridor": navigation.corridor,
    "warehouse": navigation.warehouse,
    "speed": filters.speed,
    "global": filters.global_start,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--seeds", type=int, default=100, metavar="N", help="drives (default: 100)")
    add("--rate", type=float, default=5.0, metavar="HZ", help="scans/s (default: 5)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        seeds=2 if given.quick else given.seeds,
        rate_hz=given.rate,
        quick=given.quick,
        data=find_folder("FSMSM_DATA", "data"),
    )
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
