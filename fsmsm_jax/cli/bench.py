"""`fsmsm bench`: how fast is it on this machine, and is it slower than it was?"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax

if TYPE_CHECKING:
    from fsmsm_jax.benchmark import Metric, Scene

_QUICK_WITHOUT = ("batch", "slam")  # a minute is soon spent on compiling
_REPEATS, _QUICK_REPEATS = 15, 7


def bench(
    *,
    quick: bool = False,
    only: tuple[str, ...] = (),
    json: Path | None = None,
    plots: Path | None = None,
    gate: bool = False,
    write_baseline: bool = False,
    markdown: bool = False,
    page: Path | None = None,
) -> None:
    """Measure every stage on a made-up office floor, on the device at hand.

    Times are medians and quartiles after a warm-up; the first call, compilation
    included, has a row of its own. Machines are shared, so the gate compares no
    seconds, but times in units of a reference workload that is timed in between.

    Args:
        quick: fewer repetitions, without batch and slam, and compiled programs may be
            kept: a minute.
        only: these stages (raycast, orientation, match, query, batch, tracker,
            particles, slam).
        json: write all rows there.
        plots: measure time against area, rays, batch size and devices as well, and save
            a picture of each in this folder; minutes.
        gate: exit 1 if anything is slower than the baseline of this kind of device by
            more than its tolerance.
        write_baseline: make these rows the baseline of this kind of device.
        markdown: print the table for a page instead of columns at the end.
        page: write the table of all baselines between the marks of this file, a README;
            measures nothing unless a baseline is written.
    """
    from fsmsm_jax import benchmark

    names = _wanted(only, quick, tuple(benchmark.STAGES))
    if gate and write_baseline:
        raise ValueError("compare with the baseline or write it, not both at once")
    if write_baseline and (quick or only):
        raise ValueError("the baseline is that of all stages: no --quick, no --only")
    if page is None or write_baseline:
        if gate:  # before minutes are spent, is there anything to compare with?
            benchmark.read_record(benchmark.baseline_path())
        if not quick:  # the rows of first calls are about compiling
            jax.config.update("jax_enable_compilation_cache", False)
        scene = benchmark.Scene(benchmark.Amounts.of_device())
        repeats = _QUICK_REPEATS if quick else _REPEATS
        rows = _measured(scene, names, repeats)
        if json is not None:
            benchmark.write_record(json, rows)
        if write_baseline:
            benchmark.write_record(benchmark.baseline_path(), rows)
        if markdown:
            record = benchmark.Record(benchmark.circumstances(), rows)
            print(f"\n{benchmark.markdown([record])}")
        if plots is not None:
            _draw(scene, plots)
        if gate:
            _compare(rows)
    if page is not None:
        table = benchmark.markdown(benchmark.baselines())
        page.write_text(benchmark.with_page(page.read_text(), table))


def _wanted(
    only: Sequence[str], quick: bool, known: tuple[str, ...]
) -> tuple[str, ...]:
    """The stages to measure."""
    unknown = [name for name in only if name not in known]
    if unknown:
        raise ValueError(
            f"there is no stage {', '.join(unknown)}: expected {', '.join(known)}"
        )
    return tuple(only) or tuple(n for n in known if not (quick and n in _QUICK_WITHOUT))


def _measured(scene: "Scene", names: Sequence[str], repeats: int) -> list["Metric"]:
    """All rows, printed as they come."""
    from fsmsm_jax import benchmark
    from fsmsm_jax.benchmark.page import HEAD, cells, line

    facts, rows = benchmark.circumstances(), []
    print(line(HEAD), flush=True)
    for row in benchmark.measure(scene, names, repeats):
        rows.append(row)
        print(line(cells(row, facts)), flush=True)
    return rows


def _compare(rows: Sequence["Metric"]) -> None:
    """Say what got worse than the baseline, and exit 1 if anything did."""
    from fsmsm_jax import benchmark

    baseline = benchmark.read_record(benchmark.baseline_path()).rows
    worse = benchmark.regressions(rows, baseline)
    print("\n".join(f"REGRESSION {text}" for text in worse) or "no regressions")
    if worse:
        raise SystemExit(1)


def _draw(scene: "Scene", folder: Path) -> None:
    """One picture for each question of how time grows."""
    from matplotlib.figure import Figure

    from fsmsm_jax.benchmark import CURVES
    from fsmsm_jax.plotting.benchmark import plot_scaling

    folder.mkdir(parents=True, exist_ok=True)
    for name, measured in CURVES.items():
        figure = Figure(figsize=(6, 4))
        ax = figure.add_subplot()
        for curve in measured(scene):
            plot_scaling(ax, curve.sizes, curve.seconds, curve.label)
            ax.set_xlabel(curve.size)
        ax.set_title(jax.devices()[0].device_kind)
        path = folder / f"scaling_{name}.png"
        figure.savefig(path, dpi=110, bbox_inches="tight", facecolor="white")
        print(f"picture   {path}", file=sys.stderr, flush=True)
