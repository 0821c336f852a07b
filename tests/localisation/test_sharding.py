"""One atlas on many devices, of one process and of two: the candidates of one device.

And when one of two joined processes dies, the other ends too, with an error.
"""

import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import AtlasConfig, build_atlas, tiles
from fsmsm_jax.localisation.correlative import rank_poses
from fsmsm_jax.localisation.sharding import rank_on_mesh
from fsmsm_jax.sensing import Lidar, raycast
from tests.localisation.sharded_worker import GONE, LIMIT, mesh_of, part, room
from tests.worlds import CENTRE

ROOT = Path(__file__).parents[2]
HEADINGS = [0.4, -2.0, 3.0, 1.2]
PLACES = [[0.5, 0.25], [4.0, 1.5], [-2.0, 5.0], [0.0, 3.5]]
TRUE = np.column_stack([CENTRE + PLACES, HEADINGS])
PATIENCE = 240  # [s] with processes that compile on a busy machine
SLACK = 10  # [s] to say why and die
# Half the time of compiling, in the process that the others are compared with too.
PLAIN = "--xla_backend_optimization_level=0"


@pytest.fixture(scope="module")
def scans():
    lidar = Lidar.create(180, noise=0.01, outliers=0.1, range_max=9.0)
    cast = lambda pose: raycast(room(), pose, lidar.bearings, lidar.range_max)
    keys = jax.random.split(jax.random.key(0), len(TRUE))
    return jax.vmap(lidar.measure)(keys, jax.vmap(cast)(jnp.asarray(TRUE, float)))


@pytest.fixture(scope="module")
def atlas():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "_SIDES", (28,))
        return build_atlas(room(), AtlasConfig(0.25, rays=90, reach=2.0, margin=0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, atlas, scans):
    """What all processes read; where they write, and keep what they compile."""
    folder = tmp_path_factory.mktemp("sharding")
    atlas.save(folder / "atlas.npz")
    np.savez(folder / "scans.npz", **{k: np.asarray(v) for k, v in vars(scans).items()})
    return folder


def environment(folder, devices):
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_ENABLE_X64": str(int(jax.config.jax_enable_x64)),
        "JAX_NUMPY_RANK_PROMOTION": "raise",
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices} {PLAIN}",
        "PYTHONUNBUFFERED": "1",
    }


def start(stack, folder, devices, task, *more):
    """A process of `sharded_worker`, dead at the latest when the stack is left."""
    log = folder / f"{'_'.join(map(str, (task, *more)))}.log"
    run = subprocess.Popen(
        [sys.executable, "-m", "tests.localisation.sharded_worker", task, folder]
        + [str(one) for one in more],
        cwd=ROOT,
        env=environment(folder, devices),
        stdout=stack.enter_context(log.open("w")),
        stderr=subprocess.STDOUT,
    )
    stack.callback(run.wait)
    stack.callback(run.kill)
    return run, log


def joined(stack, folder, fate):
    """Two processes of two devices each, on a port that was free a moment ago."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return [start(stack, folder, 2, fate, process, port) for process in (0, 1)]


def read(folder, name):
    with np.load(folder / f"{name}.npz") as kept:
        return dict(kept)


@pytest.fixture(scope="module")
def alone(folder):
    """What one device finds; eight devices of another process look at the same time."""
    with ExitStack() as stack:
        runs = start(stack, folder, 1, "alone"), start(stack, folder, 8, "eight")
        for run, log in runs:
            assert run.wait(PATIENCE) == 0, log.read_text()
    return read(folder, "alone")


def assert_same(found, alone, atol=0.0):
    assert alone["poses"].shape == (len(TRUE), 8, 3)
    for name in ("poses", "scores"):
        np.testing.assert_allclose(found[name], alone[name], rtol=0, atol=atol)
    np.testing.assert_array_equal(found["confident"], alone["confident"])


def test_one_device_knows_where_it_is(alone):
    np.testing.assert_allclose(alone["poses"][:, 0], TRUE, atol=0.03)
    assert alone["confident"].all()
    apart = np.ptp(alone["scores"], axis=1)
    assert (apart > 0.1).all()  # other candidates are other places


@pytest.mark.parametrize("name", ["eight", "three", "four_by_two"])
def test_devices_of_one_process_find_the_same(name, folder, alone):
    """To the last digit: each tile's arithmetic is the same wherever it runs."""
    assert_same(read(folder, name), alone)


def test_batch_on_eight_devices(folder, alone):
    """Another program, whose roundings the polish carries on: by 10 µm at most."""
    assert_same(read(folder, "eight_batch"), alone, atol=1e-5)


def test_tiles_are_shared_out_evenly(folder, atlas, alone):
    assert atlas.tiles.allowed.any(axis=(1, 2)).sum() == 12
    assert len(atlas.tiles.allowed) == 16
    held = read(folder, "held")
    assert [held[f"arr_{n}"].tolist() for n in range(3)] == [[2] * 8, [2] * 8, [6] * 3]


def test_a_mesh_of_one_device_ranks_as_without(atlas, scans):
    """The same poses; of those that score alike to 10⁻⁶ another may be the last."""
    scan, count = part(scans, 1), 256
    rank = jax.jit(rank_poses, static_argnames=("headings", "count"))
    expected = rank(atlas, scan, headings=60, count=count).poses
    found = rank_on_mesh(atlas.spread(mesh_of(1)), scan, 180, 60, count)
    listed = lambda poses: {*map(tuple, np.round(np.asarray(poses, float), 3))}
    assert len(listed(expected)) == count
    assert len(listed(expected) & listed(found)) >= 0.99 * count


def test_two_processes_find_the_same_until_one_dies(folder, alone):
    """Both know the answer; then one is gone, and the other's next call says so."""
    with ExitStack() as stack:
        (stays, log), (goes, other) = joined(stack, folder, "later")
        assert goes.wait(PATIENCE) == GONE, other.read_text()
        died = time.monotonic()
        assert stays.wait(LIMIT + SLACK) != 0
        assert time.monotonic() - died < LIMIT + SLACK
    for process in (0, 1):
        assert_same(read(folder, f"pair_{process}"), alone)
    assert "JaxRuntimeError" in log.read_text()
    assert not (folder / "went_on").exists()


@pytest.fixture(scope="module")
def bereft(folder, alone):
    """Logs of processes that wait for another, which has ended in one of two ways."""
    del alone  # its programs are used again
    logs = {}
    with ExitStack() as stack:
        pairs = {f: joined(stack, folder, f) for f in ("at_once", "raises")}
        for fate, ((stays, log), (goes, _)) in pairs.items():
            assert stays.wait(PATIENCE) != 0
            assert goes.wait(LIMIT + SLACK) != 0
            logs[fate] = log.read_text()
    return logs


@pytest.mark.parametrize(
    ("fate", "reason"),
    [("at_once", "stopped sending heartbeats"), ("raises", "Barrier timed out")],
)
def test_a_process_that_ends_before_it_is_met(fate, reason, bereft, folder):
    """By a crash it falls silent; after an error it waits for the other before it exits."""
    assert "another task died" in bereft[fate]
    assert reason in bereft[fate]
    assert not (folder / "went_on").exists()
