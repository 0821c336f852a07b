"""A thread that answers many robots, with back-pressure.

Robots ask when they like, each from a thread of its own (a connection's, say), and
wait for a `Future`. One thread takes what waits, batch by batch (`stream`): as soon as
a batch is full, or when the oldest scan has waited for the fleet's `patience`. A
bounded number of scans may wait. Who brings one more has to wait for room, or is told
so, and may drop the scan: a newer one will come.

Nothing is lost silently. A scan that cannot be localised fails its own future; closing
answers all that wait; if the thread breaks down, all futures say why.
"""

import threading
import time
from collections.abc import Hashable, Mapping
from concurrent.futures import Future
from queue import Full
from typing import NamedTuple

import jax
import numpy as np

from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.settle import Localisation, SearchConfig
from fsmsm_jax.localisation.stream import (
    Query,
    answers,
    check,
    check_counts,
    taken_out,
    together,
)
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["Fleet"]


class Fleet:
    """Answers scans that come from many threads; a context manager.

    Args:
        atlases: of each map, by name.
        config: how hard to look.
        batch: scans in a batch, at most.
        waiting: scans that may wait; `submit` blocks while so many do.
        patience: how long the oldest scan waits for a batch to fill [s].

    Raises:
        ValueError: batch or waiting are less than 1, or patience is negative.

    Example:
        >>> with Fleet({"office": atlas}) as fleet:  # doctest: +SKIP
        ...     future = fleet.submit("r2", "office", scan)
        ...     print(future.result().pose)

    Note:
        On a CPU, programs that two threads run may wait for each other for ever. So
        only the fleet's own thread runs any: `submit` is plain NumPy, and while the
        fleet is open other threads should leave JAX alone, but for making scans
        (`Scan.from_ranges` runs no program). The first batch of each shape is compiled
        while the robots wait; a persistent compilation cache spares them.
    """

    def __init__(
        self,
        atlases: Mapping[str, ScanAtlas],
        config: SearchConfig = SearchConfig(),
        *,
        batch: int = 8,
        waiting: int = 64,
        patience: float = 0.02,
    ):
        check_counts(batch=batch, waiting=waiting)
        if not patience >= 0:
            raise ValueError(f"patience is a time [s], 0 or more, got {patience}")
        self._atlases, self._config = atlases, config
        self._batch, self._room, self._patience = batch, waiting, patience
        self._waiting: list[_Job] = []
        self._changed = threading.Condition()  # guards what waits, and the two below
        self._open = False
        self._error: BaseException | None = None
        # Settings made by a context manager are its thread's own.
        self._wide = jax.dtypes.canonicalize_dtype(float) == np.float64
        self._thread = threading.Thread(target=self._work, name="fleet")

    def __enter__(self) -> "Fleet":
        self._open = True
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        """Take no more, answer all that wait."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        self._thread.join()

    def submit(
        self, robot: Hashable, map: str, scan: Scan, timeout: float | None = None
    ) -> Future[Localisation]:
        """Ask where a robot is.

        Args:
            robot: who asks; its scans are answered in order.
            map: name of the map that it is on.
            scan: what it sees.
            timeout: how long to wait for room in the queue [s]; as long as it takes,
                if left out.

        Returns:
            The future answer, in NumPy: `result()` waits for it, and raises ValueError
            if the scan has too few echoes. `cancel()` works while it waits.

        Raises:
            ValueError: there is no such map, or the scan is not a single one.
            queue.Full: no room came within the timeout; drop the scan, robots have
                newer ones. At once in a future's callback, for which all else waits.
            RuntimeError: the fleet is not open, or broke down.
        """
        query = Query(robot, map, scan)
        check(self._atlases, query)
        if threading.current_thread() is self._thread:
            timeout = 0
        with self._changed:
            room = lambda: not self._open or len(self._waiting) < self._room
            if not self._changed.wait_for(room, timeout):
                raise Full(f"{self._room} scans wait already, none was taken in time")
            if not self._open:
                raise RuntimeError(
                    "the fleet is not open; submit scans within its `with` block"
                    if self._error is None
                    else f"the fleet broke down: {self._error}"
                ) from self._error
            job = _Job(query, Future(), time.monotonic())
            self._waiting.append(job)
            self._changed.notify_all()
        return job.future

    def _work(self):
        """The thread: batch by batch, until the fleet is closed and nothing waits."""
        taken = []
        try:
            with jax.enable_x64(self._wide):
                while taken := self._next():
                    asked = [job for job in taken if job.begins()]
                    queries = [job.query for job in asked]
                    found = answers(self._atlases, queries, self._config)
                    for job, answer in zip(asked, found, strict=True):
                        job.ends(answer)
        except BaseException as error:  # whatever it is: nobody may wait for ever
            with self._changed:
                self._open, self._error = False, error
                left, self._waiting = taken + self._waiting, []
                self._changed.notify_all()
            for job in left:
                if job.future.running() or (not job.future.done() and job.begins()):
                    job.ends(error)

    def _next(self) -> list["_Job"]:
        """The next batch, waited for; none if there will be none."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or not self._open)
            if not self._waiting:
                return []
            deadline = self._waiting[0].since + self._patience
            self._changed.wait_for(self._is_full, deadline - time.monotonic())
            taken = taken_out(self._waiting, self._next_batch())
            self._changed.notify_all()
        return taken

    def _is_full(self):
        """Whether waiting longer brings nothing."""
        if not self._open or len(self._waiting) == self._room:
            return True
        return len(self._next_batch()) == self._batch

    def _next_batch(self):
        return together([job.query for job in self._waiting], self._batch)


class _Job(NamedTuple):
    """A query, its future answer, and since when it waits [s]."""

    query: Query
    future: Future[Localisation]
    since: float

    def begins(self) -> bool:
        """Whether it is still wanted; from now on it cannot be cancelled."""
        return self.future.set_running_or_notify_cancel()

    def ends(self, answer: Localisation | BaseException) -> None:
        if isinstance(answer, BaseException):
            self.future.set_exception(answer)
        else:
            self.future.set_result(answer)
