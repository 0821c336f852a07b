"""A day of use: other numbers of rays, of scans, maps of other sizes, and few programs."""

from collections import Counter
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment import FastConfig, match, match_batch
from fsmsm_jax.localisation import AtlasConfig, build_atlas, localise, localise_batch
from fsmsm_jax.localisation.fleet import Fleet
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid
from tests.localisation.simulated import part
from tests.localisation.test_search import QUICK
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE, l_room

POSE = np.array([*CENTRE + [0.5, 0.25], 0.4])
_COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compiled():
    """Counts the programs that are compiled meanwhile, by name."""
    programs, listening = Counter(), [True]

    def note(event, _, fun_name="?", **__):
        if event == _COMPILED and listening:
            programs[fun_name] += 1

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield programs
    finally:
        listening.clear()  # listeners cannot be taken back


def scan(rays, seed=0, field_of_view=2.0 * np.pi):
    """Of the L-shaped room, from about the same place."""
    rng = np.random.default_rng(seed)
    bearings = field_of_view * (np.arange(rays) / rays - 0.5)
    walls = np.asarray(l_room().start), np.asarray(l_room().end)
    ranges = cast_walls(*walls, POSE[:2], POSE[2] + bearings, 8.0)
    ranges += rng.normal(0, 0.01, rays)
    ranges[rng.integers(0, rays, rays // 20)] = np.nan
    return Scan.from_bearings(ranges, bearings, 0.1, 8.0)


def stack(scans):
    """As users do it, on the device."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scans)


@pytest.fixture(scope="module")
def atlas():
    return build_atlas(l_room(), AtlasConfig(spacing=0.5, rays=90, margin=0.0))


def test_a_day_of_localisation(atlas):
    """Two programs: of one scan, and of four, of the bucket of 353 to 384 rays."""
    batches = [
        stack([scan(rays, seed) for seed in range(size)])
        for rays, size in ((360, 3), (381, 4), (354, 3))
    ]
    with compiled() as programs:
        scans = [scan(rays, seed) for seed, rays in enumerate(range(355, 384, 4))]
        found = [localise(atlas, one, QUICK) for one in scans]
        in_batches = [localise_batch(atlas, batch, QUICK) for batch in batches]
        with Fleet({"room": atlas}, QUICK, batch=4, patience=60.0) as fleet:
            futures = [fleet.submit(n % 3, "room", one) for n, one in enumerate(scans)]
    assert programs == {"jit(query)": 1, "jit(query_batch)": 1}

    assert [len(one.pose) for one in in_batches] == [3, 4, 3]
    for one in (*found, *(part(batch, -1) for batch in in_batches)):
        np.testing.assert_allclose(one.pose, POSE, atol=0.02)
    for future, one in zip(futures, found, strict=True):
        answer = future.result(0)
        assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(answer))
        np.testing.assert_allclose(answer.pose, one.pose, atol=1e-3)
        assert answer.confident == one.confident


def test_a_day_of_matching():
    """What one scan and one batch of four needed serves all that are about their size."""
    config = FastConfig(headings=2, kept=1, looks=1, finish=1)

    def ask(sides, rays, count):
        """Of a room painted on a grid, its walls the grid's border."""
        cells = np.pad(np.zeros(np.subtract(sides, 2), int), 1, constant_values=100)
        grid = OccupancyGrid.from_cells(cells, 0.05, (*POSE[:2] - 2.0, 0.0)).padded()
        if count == 1:
            return match(grid, scan(rays), POSE, config, rays=60)
        scans = jax.tree.map(np.asarray, [scan(rays, seed) for seed in range(count)])
        scans = jax.tree.map(lambda *leaves: np.stack(leaves), *scans)
        return match_batch(grid, scans, [POSE] * count, config, rays=60)

    for count in (1, 4):
        ask((97, 110), 361, count)
    with compiled() as programs:
        for sides, rays, count in (
            ((104, 112), 384, 1),
            ((97, 105), 360, 1),
            ((99, 112), 353, 3),
            ((101, 107), 370, 4),
        ):
            found = ask(sides, rays, count)
            assert len(found.pose) == (3 if count == 1 else count)
    assert not programs
