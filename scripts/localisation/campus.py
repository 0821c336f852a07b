"""A made-up campus, 0.05 m cells: what an atlas costs, and what a query, by area.

The campus is `buildings.campus(0, free_area)`: streets, office buildings, halls, gardens.
Scans cover 270°, with 2 cm of noise and a fifth of the rays blocked. The building of the
atlas is timed once, compilation included; what the map itself holds is told apart.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from localisation.rates import among_candidates, query_times, rates
from localisation.sets import Answers, Options, ScanSet, ask_atlas, unstacked

from fsmsm_jax.benchmark import Metric, simulated_scans
from fsmsm_jax.cli.console import timed
from fsmsm_jax.localisation import build_atlas
from fsmsm_jax.world import buildings

AREAS = (25_000.0, 50_000.0, 100_000.0)  # [m²] asked for
SCANS, FEW = 50, 10  # on the largest, and on the others
RIGHT = 0.5  # [m]
MOST_GB, LONGEST_BUILD, LONGEST_QUERY = 2.0, 300.0, 1000.0  # goals [GB, s, ms]


class Cost(NamedTuple):
    """Of one campus."""

    area: float
    """Free space [m²]."""
    drawn: float
    """Seconds that the map took, its distance field and all."""
    built: float
    """Seconds that the atlas took."""
    map: int
    """Bytes."""
    atlas: int
    """Bytes, the map's not counted."""
    cases: ScanSet
    answers: Answers

    @property
    def query(self) -> float:
        """Seconds, median."""
        return float(np.median(self.answers.seconds))


def campus(options: Options) -> Iterator[Metric]:
    """Rows of the largest with goals, of the others without, and how they grow."""
    costs = []
    for area in AREAS:
        largest = area == AREAS[-1]
        count = min(SCANS if largest else FEW, options.limit or SCANS)
        cost = _measured(area, count)
        costs.append(cost)
        tail = "" if largest else f"_{area / 1e3:.0f}k"
        size, time = (MOST_GB, LONGEST_BUILD) if largest else (None, None)
        yield Metric(f"campus/free_area{tail}", cost.area, "m²")
        yield Metric(f"campus/map{tail}", cost.map / 1e9, "GB", "lower")
        yield Metric(f"campus/map_made{tail}", cost.drawn, "s", "lower")
        yield Metric(f"campus/atlas{tail}", cost.atlas / 1e9, "GB", "lower", size)
        yield Metric(f"campus/built{tail}", cost.built, "s", "lower", time)
        if not largest:
            yield Metric(f"campus/query{tail}", 1e3 * cost.query, "ms", "lower")
    cases, answers = costs[-1].cases, costs[-1].answers
    yield from rates("campus", cases, answers, limit=RIGHT)
    yield from among_candidates("campus", cases, answers, goal=97, limit=RIGHT)
    yield from query_times("campus", answers, LONGEST_QUERY)
    larger = costs[-1].area / costs[0].area
    for what in ("query", "built", "atlas"):
        grown = getattr(costs[-1], what) / getattr(costs[0], what) / larger
        unit = "of linear growth"
        yield Metric(f"campus/{what}_growth", grown, unit, "lower", 1.0)


def _measured(area: float, count: int) -> Cost:
    world, drawn = timed(lambda: buildings.campus(0, area))
    atlas, built = timed(lambda: build_atlas(world))
    held = lambda tree: sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
    free = float(np.asarray(world.free).sum()) * float(world.resolution) ** 2
    scans, poses = simulated_scans(world, count)
    cases = ScanSet(None, unstacked(scans), np.asarray(poses))
    answers = ask_atlas(atlas, cases.scans, f"campus of {free:.0f} m²")
    sizes = held(world), held(atlas) - held(atlas.world)
    return Cost(free, drawn, built, *sizes, cases, answers)
