"""Streams and fleets: who goes with whom, who waits, and what happens when it breaks.

`localise_batch` is a stand-in here that answers at once; `test_compiles` has the real one.
"""

import threading
from concurrent.futures import ThreadPoolExecutor, wait
from queue import Full

import numpy as np
import pytest

from fsmsm_jax.localisation import stream
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.fleet import Fleet
from fsmsm_jax.localisation.settle import Candidates, Localisation
from fsmsm_jax.localisation.stream import Query, localise_stream, together
from fsmsm_jax.sensing import Scan

ATLASES = {name: object.__new__(ScanAtlas) for name in ("ground", "first")}
SOON = 20.0  # [s] by when things happen that happen at once, on the busiest machine


def scan(number, rays=40, range_max=1000.0):
    """The stand-in finds the number in its first range."""
    ranges = np.full(rays, 5.0)
    ranges[0] = 1 + number  # a range of 0 m would be none
    return Scan.from_ranges(ranges, -1.0, 0.01, range_max=range_max)


BAD = scan(666.0)


class Engine:
    """In the place of `localise_batch`: notes what it was asked, waits if it is told."""

    def __init__(self):
        self.asked, self.breaks = [], None
        self.may_go = threading.Event()
        self.may_go.set()
        self.began = threading.Event()

    def __call__(self, atlas, scans, config):
        self.began.set()
        assert self.may_go.wait(SOON)
        if self.breaks is not None:
            raise self.breaks
        numbers = scans.ranges[:, 0] - 1
        if (numbers == 666.0).any():
            raise ValueError("hardly an echo")
        name = next(name for name, one in ATLASES.items() if one is atlas)
        self.asked.append((name, scans.ranges.shape))
        pose = np.stack([numbers, scans.range_max, 0 * numbers], axis=-1)
        nought = np.zeros(len(numbers))
        spread = np.zeros((len(numbers), 3, 3))
        places = Candidates(pose[:, None], *[nought[:, None]] * 3)
        return Localisation(pose, spread, nought, nought, nought > 0, places)


@pytest.fixture
def engine(monkeypatch):
    engine = Engine()
    monkeypatch.setattr(stream, "localise_batch", engine)
    yield engine
    engine.may_go.set()


def number(found):
    return float(found.pose[0])


def ask(*robots, map="ground", rays=40):
    return [Query(robot, map, scan(n, rays)) for n, robot in enumerate(robots)]


def test_a_batch_is_of_one_map_and_bucket_and_nobody_overtakes_his_own():
    queries = [
        Query("a", "ground", scan(1)),
        Query("b", "first", scan(2)),
        Query("c", "ground", scan(3, rays=37)),  # of the same bucket
        Query("d", "ground", scan(4, rays=41)),  # of the next one
        Query("b", "ground", scan(5)),  # waits for its first
        Query("a", "ground", scan(6)),
        Query("e", "ground", scan(7)),
    ]
    assert together(queries, 8) == [0, 2, 5, 6]
    assert together(queries, 3) == [0, 2, 5]
    assert together(queries[1:], 8) == [0]
    assert together(queries[3:], 8) == [0]


def test_a_stream_answers_everyone_in_few_shapes(engine):
    rng = np.random.default_rng(0)
    queries = [
        Query(int(rng.integers(5)), str(rng.choice(list(ATLASES))), scan(n, rays))
        for n, rays in enumerate(rng.integers(33, 49, 200))
    ]
    found = list(localise_stream(ATLASES, queries, batch=4, ahead=16))
    assert [answer.error for answer in found] == [None] * 200
    assert all(
        number(answer.found) == answer.query.scan.ranges[0] - 1 for answer in found
    )
    for robot in range(5):
        numbers = [number(a.found) for a in found if a.query.robot == robot]
        assert numbers == sorted(numbers)
    assert {shape for _, shape in engine.asked} <= {
        (size, rays) for size in (1, 2, 4) for rays in (40, 48)
    }
    assert len(engine.asked) < 120, "batches are hardly filled"


def test_a_stream_reads_no_farther_ahead_than_it_may(engine):
    read = []

    def endless():
        while True:
            read.append(len(read))
            yield Query("r", "ground", scan(read[-1]))

    found = localise_stream(ATLASES, endless(), batch=2, ahead=6)
    for n in range(10):
        assert number(next(found).found) == n
        assert len(read) <= n + 1 + 6
    assert list(localise_stream(ATLASES, [])) == []


def test_a_bad_scan_fails_alone(engine):
    queries = ask("a", "b", "c")
    queries[1] = queries[1]._replace(scan=BAD)
    found = list(localise_stream(ATLASES, queries))
    assert [answer.found is None for answer in found] == [False, True, False]
    assert "hardly an echo" in str(found[1].error)
    with Fleet(ATLASES, patience=SOON, batch=3) as fleet:
        good, bad, last = (fleet.submit(*query) for query in queries)
    assert (number(good.result(0)), number(last.result(0))) == (0, 2)
    with pytest.raises(ValueError, match="hardly an echo"):
        bad.result(0)


def test_scans_keep_their_range_limits_in_a_batch(engine):
    queries = [Query(n, "ground", scan(1.0, range_max=10.0 + n)) for n in range(3)]
    limits = [a.found.pose[1] for a in localise_stream(ATLASES, queries)]
    assert limits == [10, 11, 12]


def test_many_threads_get_their_own_answers_in_their_order(engine):
    done = {robot: [] for robot in range(6)}

    def drive(robot):
        for n in range(30):
            future = fleet.submit(
                robot, "ground" if n % 3 else "first", scan(100 * robot + n)
            )
            future.add_done_callback(lambda f: done[robot].append(number(f.result())))

    with Fleet(ATLASES, batch=4, waiting=5, patience=0.001) as fleet:
        with ThreadPoolExecutor(6) as threads:
            list(threads.map(drive, done))
    for robot, numbers in done.items():
        assert numbers == [100 * robot + n for n in range(30)]


def test_a_full_batch_does_not_wait_and_a_lone_scan_waits_for_its_patience(engine):
    with Fleet(ATLASES, batch=2, patience=1000 * SOON) as fleet:
        pair = [fleet.submit(*query) for query in ask("a", "b")]
        assert not wait(pair, SOON).not_done
        lone = fleet.submit(*ask("c")[0])
        assert wait([lone], 0.1).not_done
    assert lone.done(), "closing does not wait for a batch to fill"
    assert [shape for _, shape in engine.asked] == [(2, 40), (1, 40)]
    with Fleet(ATLASES, batch=2, patience=0.01) as fleet:
        assert number(fleet.submit(*ask("c")[0]).result(SOON)) == 0


def test_who_brings_too_many_waits_or_is_told(engine):
    engine.may_go.clear()
    with Fleet(ATLASES, batch=1, waiting=2) as fleet:
        first = fleet.submit("a", "ground", scan(0))
        assert engine.began.wait(SOON)
        queued = [fleet.submit("a", "ground", scan(n)) for n in (1, 2)]
        with pytest.raises(Full, match="2 scans wait already"):
            fleet.submit("b", "ground", scan(3), timeout=0.05)
        with ThreadPoolExecutor(1) as threads:
            patient = threads.submit(fleet.submit, "b", "ground", scan(4))
            assert wait([patient], 0.1).not_done
            engine.may_go.set()
            late = patient.result(SOON)
        answers = [f.result(SOON) for f in (first, *queued, late)]
    assert [number(answer) for answer in answers] == [0, 1, 2, 4]


def test_a_callback_does_not_wait_for_its_own_thread(engine):
    engine.may_go.clear()
    told = []

    def once_more(_):
        try:
            fleet.submit("a", "ground", scan(9))
        except Full as error:
            told.append(error)

    with Fleet(ATLASES, batch=1, waiting=1) as fleet:
        fleet.submit("a", "ground", scan(0)).add_done_callback(once_more)
        assert engine.began.wait(SOON)
        last = fleet.submit("a", "ground", scan(1))
        engine.may_go.set()
        assert number(last.result(SOON)) == 1
    assert len(told) == 1


def test_closing_answers_all_that_wait_and_takes_no_more(engine):
    engine.may_go.clear()
    with Fleet(ATLASES, batch=4, patience=0.0) as fleet:
        futures = [fleet.submit(*query) for query in ask(*range(20))]
        assert futures[-1].cancel(), "what waits can be called off"
        engine.may_go.set()
    assert [number(future.result(0)) for future in futures[:-1]] == list(range(19))
    with pytest.raises(RuntimeError, match="not open"):
        fleet.submit(*ask("a")[0])


def test_a_breakdown_reaches_everybody(engine):
    engine.may_go.clear()
    engine.breaks = MemoryError("no room on the device")
    with Fleet(ATLASES, batch=2, waiting=3, patience=0.0) as fleet:
        first = fleet.submit("a", "ground", scan(0))
        assert engine.began.wait(SOON)
        futures = [first, *(fleet.submit(*query) for query in ask(*"bcd"))]
        with ThreadPoolExecutor(1) as threads:
            blocked = threads.submit(fleet.submit, "e", "ground", scan(4))
            assert wait([blocked], 0.05).not_done
            engine.may_go.set()
            with pytest.raises(RuntimeError, match="no room on the device"):
                blocked.result(SOON)
        for future in futures:
            with pytest.raises(MemoryError, match="no room"):
                future.result(SOON)
        with pytest.raises(RuntimeError, match="broke down: no room"):
            fleet.submit("f", "ground", scan(5))


@pytest.mark.parametrize(
    ("query", "message"),
    [
        (("a", "cellar", scan(1)), r"no map 'cellar'; there are \['first', 'ground'\]"),
        (("a", "ground", stream.stacked([scan(1)])), "expected one Scan"),
        (("a", "ground", np.ones(40)), "expected one Scan"),
    ],
)
def test_what_is_no_query_is_refused_at_once(engine, query, message):
    query = tuple.__new__(Query, query)
    with Fleet(ATLASES) as fleet, pytest.raises(ValueError, match=message):
        stream.check(fleet._atlases, query)
    with pytest.raises(ValueError, match=message):
        list(localise_stream(ATLASES, [query]))


def test_impossible_settings_are_refused(engine):
    for settings in ({"batch": 0}, {"waiting": 0}):
        with pytest.raises(ValueError, match="must be at least 1, got 0"):
            Fleet(ATLASES, **settings)
    with pytest.raises(ValueError, match="patience"):
        Fleet(ATLASES, patience=-1.0)
    with pytest.raises(ValueError, match="ahead must be at least 1"):
        list(localise_stream(ATLASES, [], ahead=0))
    with pytest.raises(RuntimeError, match="within its `with` block"):
        Fleet(ATLASES).submit(*ask("a")[0])
