"""Scans of many robots on several maps, as one stream, in batches of few shapes.

Programs like scans in batches of a few fixed shapes, robots bring them one by one. So a
scan waits a moment for others, as requests do in inference servers (NVIDIA's Triton
calls it dynamic batching):

- a batch is the oldest scan and those behind it that are asked of the same map and have
  as many rays, up to their bucket (`sensing.buckets`), so that sensors of 360 and of
  361 rays share it. No scan overtakes another one of its robot;
- its size is a power of two: with b the largest, a map and a bucket meet log₂ b + 1
  programs at most, however the day goes;
- a bounded number of scans wait, for a queue that grows only hides that robots are too
  many. `localise_stream` is lazy, and reads no farther ahead; `fleet` blocks.

Answers are those of `localise`, up to rounding.
"""

import operator
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.search import localise_batch
from fsmsm_jax.localisation.settle import Localisation, SearchConfig
from fsmsm_jax.sensing.buckets import bucket, filled, power_of_two, stacked
from fsmsm_jax.sensing.lidar import Scan

__all__ = [
    "Answer",
    "Query",
    "answers",
    "check",
    "check_counts",
    "localise_stream",
    "taken_out",
    "together",
]

_T = TypeVar("_T")


class Query(NamedTuple):
    """Where is this robot?"""

    robot: Hashable
    """Who asks; answers to one robot keep the order of its scans."""
    map: str
    """Name of the map that it is on."""
    scan: Scan
    """What it sees."""


class Answer(NamedTuple):
    """What `localise` says, or why it says nothing."""

    query: Query
    found: Localisation | None
    """NumPy throughout; None if the scan was refused."""
    error: ValueError | None
    """Why it was: too few echoes."""


def localise_stream(
    atlases: Mapping[str, ScanAtlas],
    queries: Iterable[Query],
    config: SearchConfig = SearchConfig(),
    *,
    batch: int = 8,
    ahead: int = 64,
) -> Iterator[Answer]:
    """Answers to a stream of queries, computed in batches.

    Args:
        atlases: of each map, by name.
        queries: as they come, or from logs.
        config: how hard to look.
        batch: scans in a batch, at most.
        ahead: how many queries are read before the first of them is answered; the more,
            the fuller are the batches, and the longer does a live stream wait.

    Yields:
        One answer a query. Of one robot in its order; a robot on another map, or with
        another sensor, may come first.

    Raises:
        ValueError: a query is of no such map or of no single scan; batch or ahead are
            less than 1.

    Example:
        >>> log = [Query("r2", "office", scan), ...]  # doctest: +SKIP
        >>> for query, found, error in localise_stream({"office": atlas}, log):
        ...     print(query.robot, found.pose if error is None else error)
        ... # doctest: +SKIP
    """
    check_counts(batch=batch, ahead=ahead)
    waiting, coming = [], iter(queries)
    while True:
        for query in islice(coming, ahead - len(waiting)):
            check(atlases, query)
            waiting.append(query)
        if not waiting:
            return
        taken = taken_out(waiting, together(waiting, batch))
        for query, answer in zip(taken, answers(atlases, taken, config), strict=True):
            refused = isinstance(answer, ValueError)
            yield Answer(query, *((None, answer) if refused else (answer, None)))


def together(queries: Sequence[Query], most: int) -> list[int]:
    """Which go as one batch: the oldest, and those of its kind; none overtakes its own.

    A kind is a map and a bucket of rays.
    """
    kind = lambda query: (query.map, bucket(len(query.scan.ranges)))
    chosen, held = [], set()
    for n, query in enumerate(queries):
        if kind(query) != kind(queries[0]) or query.robot in held:
            held.add(query.robot)
        else:
            chosen.append(n)
        if len(chosen) == most:
            break
    return chosen


def taken_out(waiting: list[_T], chosen: list[int]) -> list[_T]:
    """The chosen, taken out of those that wait."""
    taken = [waiting[n] for n in chosen]
    for n in reversed(chosen):
        del waiting[n]
    return taken


def answers(
    atlases: Mapping[str, ScanAtlas], queries: Sequence[Query], config: SearchConfig
) -> list[Localisation | ValueError]:
    """An answer for each of a batch; a bad scan does not spoil those of the others."""
    if not queries:
        return []
    scans = stacked([query.scan for query in queries])
    scans = filled(scans, power_of_two(len(queries)))
    try:
        found = localise_batch(atlases[queries[0].map], scans, config)
    except ValueError as error:
        if len(queries) == 1:
            return [error]
        alone = (answers(atlases, [query], config) for query in queries)
        return [answer for some in alone for answer in some]
    found = jax.tree.map(np.asarray, found)
    return [jax.tree.map(operator.itemgetter(n), found) for n, _ in enumerate(queries)]


def check(atlases: Mapping[str, ScanAtlas], query: Query) -> None:
    """Refuse what is no query, whatever its scan sees.

    Raises:
        ValueError: there is no such map, or the scan is not a single one.
    """
    if query.map not in atlases:
        raise ValueError(f"no map {query.map!r}; there are {sorted(atlases)}")
    if not isinstance(query.scan, Scan) or np.ndim(query.scan.ranges) != 1:
        raise ValueError(
            f"expected one Scan of (rays,) ranges from robot {query.robot!r}, got "
            f"{getattr(query.scan, 'ranges', query.scan)!r:.80}; see Scan.from_ranges"
        )


def check_counts(**counts: int) -> None:
    """Refuse counts less than 1, by name."""
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
