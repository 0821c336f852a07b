"""Milliseconds a match, and three big maps with other people's cases."""

import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table, number
from thesis.worlds import Options, five_sets

from accuracy.efficiency import timed
from fsmsm_jax import Scan, load_map
from fsmsm_jax.alignment import FastConfig, FsmsmConfig, match
from fsmsm_jax.evaluation import FARTHEST, noisy, pose_errors
from fsmsm_jax.evaluation.cases import bearings

CPP = (110.0, 160.0)  # [ms] a match of the author's C++, shared/golden/peers.md
SINGLES = 40  # matches timed one by one
MAPS = ("cbgl_willow", "cbgl_warehouse", "basement_5cm")
STARTS = ("est_xy0p2_th0p785", "est_xy0p2_th0p35")


def speed(options: Options) -> Iterator[Table]:
    """Polygon worlds, alone and in a batch."""
    cases = five_sets(options).cases
    worlds, ranges = noisy(cases, 0.05, 0.0)
    ranges = jnp.minimum(ranges, FARTHEST)
    around = bearings(ranges.shape[1], ranges.dtype)
    one = lambda r: Scan(r, around, r > 0, r < FARTHEST, jnp.asarray(FARTHEST, r.dtype))
    scans = jax.vmap(one)(ranges)
    rows = []
    for name, config in (("fast", FastConfig()), ("FSMSM", FsmsmConfig())):
        found, seconds = timed(worlds, scans, cases.initial, config)
        batched = 1e3 * seconds / len(ranges)
        singles = []
        for n in range(min(SINGLES, len(ranges)) + 1):
            world, scan = jax.tree.map(lambda a, n=n: a[n], (worlds, scans))
            start = time.perf_counter()
            jax.block_until_ready(match(world, scan, cases.initial[n], config))
            singles.append(1e3 * (time.perf_counter() - start))
        quartiles = np.percentile(singles[1:], [25, 50, 75])  # the first compiles
        single = quartiles[1]
        rows.append(
            (
                *(name, number(np.median(found.scans))),
                *(
                    number(batched),
                    f"{number(CPP[0] / batched)} to {number(CPP[1] / batched)}",
                ),
                f"{number(single)} [{number(quartiles[0])}, {number(quartiles[2])}]",
                f"{number(CPP[0] / single)} to {number(CPP[1] / single)}",
            )
        )
    head = (
        "method",
        "virtual scans",
        "batched [ms]",
        "times C++",
        "single [ms]",
        "times C++",
    )
    note = (
        f"{len(ranges)} matches, covariance and verdict included; single: median and "
        f"quartiles. The C++ took {CPP[0]:.0f} to {CPP[1]:.0f} ms on such a machine "
        "(shared/golden/peers.md), not measured again here. Goal: 40 and 20 times."
    )
    yield Table("Speed: polygon worlds", head, rows, note)


def gl(options: Options) -> Iterator[Table]:
    """Three maps of 600 to 2000 m², 50 scans each, σ = 0.03 m."""
    if options.data is None:
        return
    rows = []
    for name in MAPS:
        world = load_map(options.data / "gl" / f"{name}.yaml")
        with np.load(options.data / "gl" / f"{name}_cases.npz") as log:
            arrays = dict(log)
        angles = float(arrays["angle_min"]), float(arrays["angle_increment"])
        each = [
            Scan.from_ranges(ranges, *angles, range_max=30.0)
            for ranges in arrays["ranges_sigma0p03"]
        ]
        scans = jax.tree.map(lambda *a: jnp.stack(a), *each)
        for start in STARTS:
            found, seconds = timed(world, scans, arrays[start], FastConfig())
            metres, _ = pose_errors(found.pose, jnp.asarray(arrays["true_pose"], float))
            metres = np.asarray(metres, float)
            rows.append(
                (
                    *(name, start, f"{100 * np.mean(metres < 0.05):.0f} %"),
                    number(1e3 * np.median(metres)),
                    number(1e3 * np.quantile(metres, 0.95)),
                    number(1e3 * seconds / len(each)),
                )
            )
    head = ("map", "start", "< 5 cm", "median [mm]", "95 % [mm]", "ms a match")
    note = "PLICP: 90 to 96 %, 3.1 mm, 0.5 to 1.0 ms. Goal: 100 %, 3 mm, 1 ms."
    yield Table("Three big maps", head, rows, note)
