"""The thesis's program on its own 778 pairs, case by case, and the time it takes."""

import csv
from collections import defaultdict
from collections.abc import Iterator

import jax
import numpy as np
from thesis.report import Table, interval, number, pair
from thesis.worlds import Options, five_sets, progress

from fsm.pairs import PROGRAM, WAYS, answers, pairs_of
from fsmsm_jax.evaluation import mean_of, published_cases


def golden(options: Options) -> Iterator[Table]:
    """The author's C++ and ours on the same pairs and noise."""
    asked = _asked(options)
    if asked is None:
        return
    cases, theirs = asked
    rows, times = [], []
    for sigma in (0.05,) if options.quick else sorted(theirs):
        pairs = pairs_of(cases, sigma)
        cpp_position, cpp_turn, cpp_seconds = theirs[sigma]
        for way in WAYS:
            progress(f"golden: {way}, σ {sigma:g}")
            ours = answers(pairs, PROGRAM[way], again=3)
            near = np.abs(ours.position - cpp_position) < 1e-3
            middle = lambda e: pair((np.median(e), np.mean(e)), 1e3)
            rows.append(
                (
                    f"{sigma:g}",
                    way,
                    middle(cpp_position),
                    middle(ours.position),
                    interval(mean_of(ours.position - cpp_position), 1e3, 2),
                    middle(cpp_turn),
                    middle(ours.orientation),
                    interval(mean_of(ours.orientation - cpp_turn), 1e3, 2),
                    number(100 * np.mean(near)),
                    number(100 * np.mean(ours.converged), 4),
                    "" if np.isnan(ours.nees) else number(ours.nees),
                )
            )
            cpp = 1e3 * np.median(cpp_seconds)
            mine = 1e3 * ours.seconds
            times.append((f"{sigma:g}", way, *map(number, (cpp, mine, mine / cpp))))
    yield Table(
        f"The author's C++ on the same {len(cases.true)} pairs",
        (
            *("σ_R [m]", "ours", "position [mm], C++", "ours", "mean difference"),
            *("orientation [mrad], C++", "ours", "mean difference"),
            *("within 1 mm of the C++'s error [%]", "converged [%]", "NEES"),
        ),
        rows,
        "Median / mean; differences ours − C++ case by case, with 95 % interval. NEES: "
        "mean over those that converged, 3 is honest.",
    )
    yield Table(
        "Milliseconds a match",
        ("σ_R [m]", "ours", "C++, one thread", "ours, batched", "ours / C++"),
        times,
        "The C++'s CPU time as recorded on a 2-core machine of this kind, median; ours "
        "is the wall time of one call for all pairs over their number, median of 3, "
        "compiling left out.",
    )


def _asked(options: Options):
    """The pairs and, by noise, the C++'s errors and times on them."""
    folder = options.golden
    if folder is None or not (folder / "fsm_bench.csv").is_file():
        progress("golden: no results of the C++ at hand, left out")
        return None
    with np.load(folder / "fsm_bench_cases.npz") as file:
        arrays = {name: file[name] for name in file.files}
    results = defaultdict(dict)
    with (folder / "fsm_bench.csv").open() as file:
        for line in csv.DictReader(file):
            if line["method"] == "FSM":
                results[float(line["sigma_R"])][int(line["dataset_id"])] = tuple(
                    float(line[key])
                    for key in ("position_error_m", "orientation_error_rad", "cpu_s")
                )
    ids = arrays["dataset_id"]
    keep = slice(options.worlds if options.quick else None)
    cases = jax.tree.map(lambda a: a[keep], published_cases(arrays))
    return cases, {
        sigma: np.array([by_id[i] for i in ids[keep]]).T
        for sigma, by_id in results.items()
    }


def times(options: Options) -> Iterator[Table]:
    """One pair alone, and many."""
    asked = five_sets(options, worlds=500)
    pairs = pairs_of(asked.cases, 0.05)
    count = len(asked.sets)
    rows = []
    for way in WAYS:
        alone = jax.tree.map(lambda a: a[:1], pairs)
        ones = answers(alone, PROGRAM[way], again=3 if options.quick else 50)
        many = answers(pairs, PROGRAM[way], again=1 if options.quick else 5)
        rows.append((way, number(1e3 * ones.seconds), number(1e3 * many.seconds)))
    yield Table(
        "Milliseconds a match, alone and together",
        ("ours", "alone", f"{count} in one call"),
        rows,
        f"{asked.described} Checks of the input, verdict and covariance included.",
    )
