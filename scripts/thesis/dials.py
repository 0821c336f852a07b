"""What the dials of a matcher do: sampling degrees, the sensor's reach, and the clock."""

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from matplotlib.figure import Figure
from thesis import published
from thesis.report import Table, interval, number, pair, percent, save
from thesis.worlds import (
    OURS,
    Matcher,
    Options,
    climbing,
    config_of,
    five_sets,
    laserazos,
    progress,
)

from fsmsm_jax.evaluation import Row, degree_sweep, noisy, range_limit_sweep
from fsmsm_jax.plotting import POSE, SCAN, plot_sweep

_FINISH = 6  # the default's Gauss-Newton steps
_REACHES = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 1000.0)


def degrees(options: Options) -> Iterator[Table]:
    """§6.3: uf from ν = 0 up, no noise; and the same with a Gauss-Newton finish."""
    asked = laserazos(options)
    tops = range(1) if options.quick else range(7)
    batch = len(asked.sets)
    sweep = lambda finish, tops: degree_sweep(
        asked.cases, lambda top: Matcher(climbing(top, finish)), tops, batch=batch
    )
    progress("degrees: as published")
    plain = sweep(0, tops)
    progress("degrees: finished by Gauss-Newton")
    finished = sweep(_FINISH, range(0 if options.quick else 4))
    rows = []
    for top, row in zip(tops, plain, strict=True):
        with_finish = finished[top] if top < len(finished) else None
        cell = lambda field, row=with_finish: (
            interval(getattr(row, field).mean, 1e3) if row else ""
        )
        rows.append(
            (
                str(top),
                interval(row.position.mean, 1e3),
                number(published.DEGREES_POSITION[top]),
                cell("position"),
                interval(row.orientation.mean, 1e3),
                number(published.DEGREES_ORIENTATION[top]),
                cell("orientation"),
                number(row.scans.mean.value),
            )
        )
    yield Table(
        "The largest sampling degree: uf without noise, mean errors",
        (
            "ν_max",
            "position [mm]",
            "thesis",
            f"and {_FINISH} Gauss-Newton steps",
            "orientation [mrad]",
            "thesis",
            f"and {_FINISH} Gauss-Newton steps",
            "virtual scans, mean",
        ),
        rows,
        f"{asked.described} ν_min = 0; no CAER limit.",
    )
    figure = Figure(figsize=(8.5, 3.6), layout="constrained")
    fields = (
        ("position", published.DEGREES_POSITION, "mean position error [mm]"),
        ("orientation", published.DEGREES_ORIENTATION, "mean orientation error [mrad]"),
    )
    for ax, (field, theirs, label) in zip(figure.subplots(1, 2), fields, strict=True):
        for mine, name, colour, beside in (
            (plain, "uf", SCAN, theirs),
            (finished, "uf and Gauss-Newton", POSE, None),
        ):
            if not mine:
                continue
            mean = np.array([getattr(row, field).mean for row in mine]).T * 1e3
            x = np.arange(len(mine))
            plot_sweep(ax, x, mean[0], name, colour, (mean[1], mean[2]), beside)
        ax.set(xlabel="ν_max", ylabel=label, xticks=list(tops))
    figure.axes[0].legend(frameon=False, fontsize=8)
    save(figure, options.out, "degrees")


def range_limits(options: Options) -> Iterator[Table]:
    """§6.6: errors by the sensor's reach and by the share of rays within it."""
    asked = five_sets(options, worlds=400)
    names = (OURS,) if options.quick else (OURS, "fm")
    reaches = _REACHES[3::6] if options.quick else _REACHES
    rows, shares = [], []
    for name in names:
        progress(f"range: {name}")
        config = config_of(name, 0.05)
        if not options.quick:  # there the program of `main` serves
            # Nobody waits for a hundred fresh starts of what cannot succeed.
            config = dataclasses.replace(config, max_recoveries=10)
        make = lambda reach, config=config: Matcher(config, reach)
        found = range_limit_sweep(
            asked.cases, make, reaches, 0.05, batch=len(asked.sets)
        )
        for reach, row in zip(reaches, found, strict=True):
            rows.append(
                (
                    name,
                    f"{reach:g}",
                    number(100 * np.mean(row.errors.in_range)),
                    percent(row.success),
                    interval(row.position.median, 1e3),
                    interval(row.position.mean, 1e3),
                    interval(row.orientation.median, 1e3),
                )
            )
        shares += _by_share(name, found)
    head = ("success [%]", "position median [mm]", "mean", "orientation median [mrad]")
    yield Table(
        "A shorter reach, σ_R = 0.05 m",
        ("method", "r_max [m]", "rays in range [%]", *head),
        rows,
        f"{asked.described} The thesis finds errors nominal while 80 % of the rays "
        "are in range.",
    )
    yield Table(
        "The same by the share of rays in range",
        ("method", "rays in range [%]", "n", "position median / mean [mm]", "success"),
        shares,
    )


def _by_share(name: str, found: Sequence[Row]) -> list[tuple[str, ...]]:
    gather = lambda field: np.concatenate([getattr(r.errors, field) for r in found])
    share, position, good = map(gather, ("in_range", "position", "success"))
    edges = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.01)
    rows = []
    for low, high in zip(edges, edges[1:], strict=False):
        here = (low <= share) & (share < high)
        if here.any():
            errors = position[here]
            rows.append(
                (
                    name,
                    f"{100 * low:.0f} to {100 * min(high, 1):.0f}",
                    str(here.sum()),
                    pair((np.median(errors), np.mean(errors)), 1e3),
                    number(100 * np.mean(good[here]), 4),
                )
            )
    return rows


def times(options: Options) -> Iterator[Table]:
    """Milliseconds a match, alone and in a batch, compiling apart."""
    asked = five_sets(options, worlds=500)
    alone, again = (2, 1) if options.quick else (40, 5)
    cells = (
        ((0.05, 0.0),) if options.quick else ((0.01, 0.0), (0.05, 0.0), (0.05, 0.05))
    )
    rows = []
    for name in (OURS,) if options.quick else (OURS, "fm"):
        for cell in cells:
            progress(f"time: {name}, σ_R {cell[0]}, σ_M {cell[1]}")
            worlds, ranges = noisy(asked.cases, *cell)
            together, single = (Matcher(config_of(name, *cell)) for _ in range(2))
            for _ in range(again):
                together(worlds, ranges, asked.cases.initial)
            spread = np.linspace(0, len(asked.sets) - 1, alone).astype(int)
            for i in (spread[0], *spread):
                one = jax.tree.map(
                    lambda a, i=i: a[i : i + 1], (worlds, ranges, asked.cases.initial)
                )
                single(*one)
            batched = 1e3 * np.array(together.seconds) / len(asked.sets)
            singly = 1e3 * np.array(single.seconds[1:])
            theirs = published.PROGRAM_MILLISECONDS.get((name, *cell))
            rows.append(
                (
                    name,
                    f"{cell[0]:g}",
                    f"{cell[1]:g}",
                    _spread(batched),
                    _spread(singly),
                    number(np.mean(singly)),
                    number(together.compile_seconds)
                    if together.compile_seconds
                    else "",
                    pair(theirs),
                    pair(published.MILLISECONDS.get(name, {}).get(cell)),
                )
            )
    yield Table(
        "Milliseconds a match",
        (
            "method",
            "σ_R [m]",
            "σ_M [m]",
            f"batch of {len(asked.sets)}: median (min to max)",
            "one by one: median (p10 to p90)",
            "mean",
            "compiling [s]",
            "the C++, median / mean",
            "thesis, median / mean",
        ),
        rows,
        "Ours with all cores, wall clock. The C++'s are CPU ms of one thread, measured "
        "elsewhere on the same kind of machine (2 virtual cores) on 195 laserazos "
        "worlds; the thesis's are of one thread at 4.0 GHz.",
    )


def _spread(ms: np.ndarray) -> str:
    low, middle, high = np.percentile(ms, (10, 50, 90) if len(ms) > 9 else (0, 50, 100))
    return f"{number(middle)} ({number(low)} to {number(high)})"
