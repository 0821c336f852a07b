"""Does L-SLAM do what its paper says? Its figures, on simulation and recordings.

    python scripts/reproduce_lslam.py --out pictures           # everything, half an hour
    python scripts/reproduce_lslam.py --only simulation --seeds 100
    python scripts/reproduce_lslam.py --quick                  # does it run at all?

In order:

- `simulation`: figure 2b, errors against particles where landmarks are known;
- `carpark`: figure 3b, the same on the paper's recording, association unknown;
- `time`: figure 4, microseconds a step at equal particles;
- `consistency`: do the filters know how wrong they are?
- `victoria`: Victoria Park, 4 km; `mrclam`: robots among barcodes.

The paper's figures came to us without their numbers, its equations not at all: beside
ours stand the specification's prototype and what the paper says in words. Recordings
are looked for at ../shared/data, or where FSMSM_DATA points; without them their
sections print nothing. Everything is drawn from fixed keys: the same command gives the
same numbers, up to the clock's.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from lslam import carpark, clock, consistency, recordings, simulation
from lslam.runs import Options
from thesis.report import Table, find_folder, parser_of, print_sections

SECTIONS: dict[str, Callable[[Options], Iterator[Table]]] = {
    "simulation": simulation.simulation,
    "carpark": carpark.carpark,
    "time": clock.times,
    "consistency": consistency.consistent,
    "victoria": recordings.victoria,
    "mrclam": recordings.mrclam,
}


def main() -> None:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--seeds", type=int, default=400, metavar="N", help="worlds (default: 400)")
    add("--quick", action="store_true", help="a few of everything: does it run?")
    add("--out", type=Path, metavar="FOLDER", help="write pictures there")
    add("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    given = parser.parse_args()
    options = Options(
        seeds=given.seeds,
        quick=given.quick,
        out=given.out,
        data=find_folder("FSMSM_DATA", "data"),
    )
    print_sections(SECTIONS, given.only, options, given.markdown)


if __name__ == "__main__":
    main()
