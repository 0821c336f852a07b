import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.io.stored import load_query, load_tracker, save_query, save_tracker
from fsmsm_jax.localisation import AtlasConfig, build_atlas, search, tracker
from fsmsm_jax.localisation.settle import Candidates, Localisation, SearchConfig
from fsmsm_jax.sensing import Lidar, Scan, raycast
from tests.worlds import CENTRE, l_room

WORLD = l_room()
LIDAR = Lidar.create(36, range_max=9.0, noise=0.0)
START = jnp.array([*CENTRE, 0.4])
MOVE = jnp.array([0.08, 0.02, 0.05])
END = geometry.compose(START, MOVE)


def scan_from(pose):
    ranges = np.asarray(raycast(WORLD, pose, LIDAR.bearings, LIDAR.range_max))
    return Scan.from_bearings(ranges, np.asarray(LIDAR.bearings), range_max=9.0)


SCAN = scan_from(END)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("stored") / "robot.fsmsm"
    save_tracker(path, WORLD, SCAN)
    return path


FRESH = """
import json, sys
import jax, numpy as np
from fsmsm_jax.localisation import correction, judge, tracker
from fsmsm_jax.sensing import raycast

def never(*arguments, **options):
    raise AssertionError("traced")

tracker.step = tracker.correct = tracker.explain = never
from fsmsm_jax.io.stored import load_tracker
from fsmsm_jax.sensing import Scan

given = {k: np.asarray(v) for k, v in json.load(sys.stdin).items()}
robot = load_tracker(sys.argv[1])
scan = Scan.from_bearings(given["ranges"], given["bearings"], range_max=9.0)
state = robot.init(given["pose"], odometry=np.zeros(3))
state, info = robot.step(state, scan, given["move"])
leaves = jax.tree.leaves((state, info))
print(json.dumps([np.asarray(leaf).tolist() for leaf in leaves]))
"""


def test_a_fresh_process_takes_the_same_step_without_tracing(stored):
    given = {"ranges": SCAN.ranges, "bearings": SCAN.bearings, "pose": START}
    given = {k: np.asarray(v).tolist() for k, v in (given | {"move": MOVE}).items()}
    run = subprocess.run(
        [sys.executable, "-c", FRESH, str(stored)],
        input=json.dumps(given),
        env=os.environ | {"JAX_ENABLE_X64": str(int(jax.config.jax_enable_x64))},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.replace("NaN", "null"))

    state = tracker.init(WORLD, START, None, jnp.zeros(3))
    expected = jax.tree.leaves(tracker.step(WORLD, state, SCAN, MOVE))
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=2e-5)  # compiled once more
    np.testing.assert_allclose(found[0], END, atol=5e-3)


def test_a_scan_of_another_sensor_is_refused(stored, monkeypatch):
    monkeypatch.setattr(jax.stages.Lowered, "compile", lambda self: None)  # seconds
    robot = load_tracker(stored)
    state = robot.init(np.asarray(START))
    assert not robot.with_moments
    with pytest.raises(ValueError, match=r"takes arrays of shapes .*\(36,\).*got .*35"):
        robot.step(state, jax.tree.map(lambda a: a[:35] if a.ndim else a, SCAN))
    with pytest.raises(ValueError, match="stored without moments"):
        robot.step(state, SCAN, moments=np.zeros(36))
    with pytest.raises(ValueError, match=r"cannot read a query .*holds a tracker"):
        load_query(stored)
    with pytest.raises(ValueError, match=r"expected one scan .* \(2, 36\)"):
        save_tracker(stored, WORLD, jax.tree.map(lambda a: jnp.stack([a, a]), SCAN))


def test_a_tracker_with_moments_wants_them(tmp_path, monkeypatch):
    monkeypatch.setattr(jax.stages.Lowered, "compile", lambda self: None)
    moments = np.linspace(-1, 0, 36)
    save_tracker(tmp_path / "swept", WORLD, SCAN, moments)
    robot = load_tracker(tmp_path / "swept")
    assert robot.with_moments
    with pytest.raises(ValueError, match="wants them"):
        robot.step(robot.init(START), SCAN)


def test_a_query_answers_as_the_search_does(tmp_path, monkeypatch):
    """The plumbing, around a search that takes no half minute to compile."""

    @jax.jit
    def quick(atlas, scan, config):
        score = atlas.lattice.frame.sum() + scan.ranges[: config.reported]
        poses = jnp.outer(score, jnp.arange(3.0))
        candidates = Candidates(poses, score, 2 * score, -score)
        spread = jnp.diag(poses[1])
        return Localisation(
            poses[0], spread, score[0], score[1], score[0] > 0, candidates
        )

    monkeypatch.setattr(search, "query", quick)
    atlas = build_atlas(WORLD, AtlasConfig(spacing=1.0, margin=0.0))
    save_query(tmp_path / "query", atlas, SCAN, SearchConfig(reported=5))
    query = load_query(tmp_path / "query")
    for scan in (SCAN, scan_from(START)):
        expected = quick(atlas, scan, SearchConfig(reported=5))
        found = query(scan)
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6)
    with pytest.raises(ValueError, match="0 of 36 rays met something within 15.0 m"):
        query(Scan.from_bearings(np.full(36, 30.0), np.asarray(SCAN.bearings)))


@pytest.mark.slow
def test_the_whole_search_in_a_file(tmp_path):
    atlas = build_atlas(WORLD, AtlasConfig(spacing=0.5, margin=0.0))
    save_query(tmp_path / "query", atlas, SCAN)
    found = load_query(tmp_path / "query")(SCAN)
    expected = search.localise(atlas, SCAN)
    np.testing.assert_allclose(found.pose, expected.pose, atol=1e-4)
    np.testing.assert_allclose(found.pose, END, atol=5e-3)
