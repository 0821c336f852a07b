"""The main evaluation, figures 6.23 to 6.33: five recordings, ten levels of noise."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from thesis import published
from thesis.published import CELLS, SIGMAS_M, SIGMAS_R
from thesis.report import Table, interval, number, pair, percent, save
from thesis.worlds import (
    NAMES,
    OURS,
    Asked,
    Matcher,
    Options,
    config_of,
    five_sets,
    progress,
)

from fsmsm_jax.evaluation import Cases, Row, match_row
from fsmsm_jax.plotting import plot_errors


class Measured(NamedTuple):
    """A row and how long its matches took together."""

    row: Row
    seconds: float


def one_row(cases: Cases, name: str, sigma_R: float, sigma_M: float) -> Measured:
    match = Matcher(config_of(name, sigma_R, sigma_M))
    row = match_row(cases, match, sigma_R, sigma_M, batch=len(cases.true))
    return Measured(row, sum(match.seconds))


def main(options: Options) -> Iterator[Table]:
    """The evaluation of §6.5: five recordings, ten levels of noise."""
    asked = five_sets(options)
    names, cells = options.methods, CELLS
    if options.quick:
        names, cells = (OURS, "x1"), ((0.05, 0.0),)
    results: dict[tuple[str, float, float], Measured] = {}
    for name in names:
        for cell in cells:
            results[name, *cell] = one_row(asked.cases, name, *cell)
            progress(
                f"main: {name}, σ_R {cell[0]}, σ_M {cell[1]}: "
                f"{results[name, *cell].seconds:.1f} s"
            )
    yield from _main_tables(asked, results)
    if not options.quick:
        save(_boxes(asked, results, names), options.out, "errors")


def _main_tables(asked, results) -> Iterator[Table]:
    order = sorted(results, key=lambda key: (key[2], key[1], NAMES.index(key[0])))
    answers, costs, weighted = [], [], []
    weights = thesis_weights(asked)
    for name, *cell in order:
        row, seconds = results[name, *cell]
        where = tuple(cell)
        at = (f"{where[1]:g}", f"{where[0]:g}", name)
        theirs = lambda table, n=name, w=where: table.get(n, {}).get(w)
        success = theirs(published.SUCCESS)
        position, orientation = row.position, row.orientation
        answers.append(
            (
                *at,
                percent(row.success),
                number(success[0], 4) if success else "",
                interval(position.median, 1e3),
                interval(position.mean, 1e3),
                pair(theirs(published.POSITION)),
                interval(orientation.median, 1e3),
                interval(orientation.mean, 1e3),
                pair(theirs(published.ORIENTATION)),
            )
        )
        costs.append(
            (
                *at,
                pair((row.scans.median.value, row.scans.mean.value)),
                pair(theirs(published.VIRTUAL_SCANS)),
                pair((row.steps.median.value, row.steps.mean.value)),
                interval(row.recoveries),
                percent(row.converged),
                number(1e3 * seconds / row.n),
                pair(theirs(published.MILLISECONDS)),
            )
        )
        if weights is not None:
            weighted.append(
                (
                    *at,
                    number(100 * weighted_middle(row.errors.success, weights)[1], 4),
                    number(success[0], 4) if success else "",
                    pair(weighted_middle(row.errors.position, weights), 1e3),
                    pair(theirs(published.POSITION)),
                    pair(weighted_middle(row.errors.orientation, weights), 1e3),
                    pair(theirs(published.ORIENTATION)),
                )
            )
    cell = ("σ_M [m]", "σ_R [m]", "method")
    both = "median / mean"
    yield Table(
        "Main evaluation: errors, with 95 % intervals",
        (
            *cell,
            "success [%]",
            "thesis",
            "position median [mm]",
            "mean",
            f"thesis, {both}",
            "orientation median [mrad]",
            "mean",
            f"thesis, {both}",
        ),
        answers,
        f"{asked.described} δ = (0.20 m, π/4), N_s = 360. The thesis has 454 020 "
        "matches a cell, its five recordings weighed by size.",
    )
    if weighted:
        yield Table(
            "Main evaluation: the same, the recordings weighed by size as in the thesis",
            (
                *cell,
                "success [%]",
                "thesis",
                f"position [mm], {both}",
                "thesis",
                f"orientation [mrad], {both}",
                "thesis",
            ),
            weighted,
            ", ".join(f"{name} {scans}" for name, scans in published.SCANS.items())
            + " scans.",
        )
    yield Table(
        "Main evaluation: cost",
        (
            *cell,
            f"virtual scans, {both}",
            "thesis",
            f"outer steps, {both}",
            "recoveries",
            "converged [%]",
            "ms a match, batched",
            f"thesis [ms], {both}",
        ),
        costs,
        "Ours in one batch on the device above, compiling left out; the thesis's one "
        "by one on one thread at 4.0 GHz.",
    )
    if len(asked.names) > 1:
        yield _by_set(asked, results)


def thesis_weights(asked: Asked) -> np.ndarray | None:
    if set(asked.names) != set(published.SCANS):
        return None
    weights = np.array([published.SCANS[asked.names[s]] for s in asked.sets], float)
    return weights / weights.sum()


def weighted_middle(sample: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Median and mean of a weighted sample."""
    order = np.argsort(sample)
    middle = np.searchsorted(np.cumsum(weights[order]), 0.5)
    return float(sample[order][middle]), float(np.sum(weights * sample))


def _by_set(asked: Asked, results) -> Table:
    """Where the errors come from, at one level of noise."""
    cell = (0.05, 0.0)
    names = [name for name in NAMES if (name, *cell) in results]
    rows = []
    for index, origin in enumerate(asked.names):
        here = asked.sets == index
        errors = [results[name, *cell].row.errors for name in names]
        middle = lambda e, here=here: (np.median(e[here]), np.mean(e[here]))
        rows.append(
            (origin, str(here.sum()))
            + tuple(pair(middle(e.position), 1e3) for e in errors)
            + tuple(pair(middle(e.orientation), 1e3) for e in errors)
        )
    return Table(
        "Main evaluation: by recording, σ_R = 0.05 m, σ_M = 0, median / mean",
        ("recording", "n")
        + tuple(f"position, {name} [mm]" for name in names)
        + tuple(f"orientation, {name} [mrad]" for name in names),
        rows,
    )


def _boxes(asked, results, names: Sequence[str]) -> Figure:
    """Errors by noise, the published medians and means beside them."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    quantities = (
        ("position", published.POSITION, "position error [mm]"),
        ("orientation", published.ORIENTATION, "orientation error [mrad]"),
    )
    shown = [name for name in names if name != "uf"]  # equal to fm
    for line, (field, theirs, label) in zip(axes, quantities, strict=True):
        for ax, sigma_M in zip(line, SIGMAS_M, strict=True):
            errors = {
                name: [
                    getattr(results[name, sigma_R, sigma_M].row.errors, field)
                    for sigma_R in SIGMAS_R
                ]
                for name in shown
            }
            marks = {
                name: [theirs[name][sigma_R, sigma_M] for sigma_R in SIGMAS_R]
                for name in shown
                if name in theirs
            }
            plot_errors(ax, errors, [f"{sigma_R:g}" for sigma_R in SIGMAS_R], marks)
        line[0].set_ylabel(label)
    for ax, sigma_M in zip(axes[0], SIGMAS_M, strict=True):
        ax.set_title(f"σ_M = {sigma_M:g} m")
    for ax in axes[1]:
        ax.set_xlabel("σ_R [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(
        f"{asked.described} Box: half of the errors, whiskers: nine tenths, dot: "
        "mean.  —, ×: published median, mean.",
        fontsize=9,
    )
    return figure
