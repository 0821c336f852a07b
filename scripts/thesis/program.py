"""The thesis's program on its own cases: 195 laserazos worlds, case by case.

Its worlds, poses and noise draws are in `fsm_bench_cases.npz`, its answers in
`fsm_bench.csv` (`../shared/golden`, or where FSMSM_GOLDEN points).
"""

import csv
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from thesis.main_table import one_row
from thesis.report import Table, interval, number, pair
from thesis.worlds import OURS, Options, progress

from fsmsm_jax.evaluation import Row, mean_of, published_cases

_PROGRAM = {"fm": "FMT", "uf": "DBH", "x1": "SKG"}  # as its result file calls them


def golden(options: Options) -> Iterator[Table]:
    """The author's C++ and ours on the same worlds, poses and noise, case by case."""
    folder = options.golden
    if folder is None or not (folder / "fsm_bench.csv").is_file():
        progress("golden: no results of the C++ at hand, left out")
        return
    with np.load(folder / "fsm_bench_cases.npz") as file:
        arrays = {name: file[name] for name in file.files}
    program = _program_results(folder / "fsm_bench.csv")
    methods = [name for name in options.methods if name in _PROGRAM]
    found = {}
    for name in methods[:1] if options.quick else methods:
        cells = sorted({key[1:] for key in program if key[0] == _PROGRAM[name]})
        rows = []
        for cell in ((0.05, 0.0),) if options.quick else cells:
            theirs = program[_PROGRAM[name], *cell]
            ids = sorted(theirs)[: options.worlds if options.quick else None]
            index = np.searchsorted(arrays["dataset_id"], ids)
            cases = published_cases(arrays, exact_ranges=cell[0] == 0)
            cases = jax.tree.map(lambda a, i=index: a[i], cases)
            results = np.array([theirs[i] for i in ids]).T
            for ours in (name, OURS):
                progress(f"golden: {ours} beside {name}, σ_R {cell[0]}, σ_M {cell[1]}")
                # Every method was asked the same cases, so ours need not be twice.
                key = ours, cell, tuple(ids)
                found[key] = found.get(key) or one_row(cases, ours, *cell).row
                rows.append(_paired(found[key], ours, cell, results))
        yield _table(name, rows)


def _table(name: str, rows: list[tuple[str, ...]]) -> Table:
    return Table(
        f"The author's C++ on the same cases: {name} ({_PROGRAM[name]})",
        (
            "ours",
            "σ_R [m]",
            "σ_M [m]",
            "n",
            "success [%], C++",
            "ours",
            "position [mm], C++",
            "ours",
            "mean difference",
            "orientation [mrad], C++",
            "ours",
            "mean difference",
            "within 1 mm of the C++'s error [%]",
        ),
        rows,
        "Median / mean; differences ours − C++ case by case, with 95 % interval. The "
        f"C++ computes in doubles, ours here in {jnp.zeros(()).dtype}.",
    )


def _program_results(path: Path) -> dict[tuple[str, float, float], dict[int, tuple]]:
    """Position error, orientation error, and their values at the start, by case."""
    results = defaultdict(dict)
    with path.open() as file:
        for line in csv.DictReader(file):
            key = line["method"], float(line["sigma_R"]), float(line["sigma_V"])
            results[key][int(line["dataset_id"])] = (
                float(line["position_error_m"]),
                float(line["orientation_error_rad"]),
                float(line["init_position_offset_m"]),
                float(line["init_orientation_offset_rad"]),
            )
    return dict(results)


def _paired(row: Row, ours, cell, results) -> tuple[str, ...]:
    position, orientation, *start = results
    better = np.hypot(position, orientation) < np.hypot(*start)
    middle = lambda e: pair((np.median(e), np.mean(e)), 1e3)
    same = np.abs(row.errors.position - position) < 1e-3
    return (
        "default" if ours == OURS else "published",
        f"{cell[0]:g}",
        f"{cell[1]:g}",
        str(row.n),
        number(100 * np.mean(better), 4),
        number(100 * row.success.value, 4),
        middle(position),
        middle(row.errors.position),
        interval(mean_of(row.errors.position - position), 1e3, 2),
        middle(orientation),
        middle(row.errors.orientation),
        interval(mean_of(row.errors.orientation - orientation), 1e3, 2),
        number(100 * np.mean(same)),
    )
