import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import cli, geometry
from fsmsm_jax.io import read_tum, write_tum
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import PolygonMap

SCANS, EMPTY = 24, 15
STAMPS = 100.0 + 0.2 * np.arange(SCANS)
ROOM = [[30, -10], [36, -10], [36, -7], [38, -7], [38, -4], [30, -5]]
DESK = [[32, -9.5], [33.2, -9.5], [33.2, -9], [32, -9]]
STEP = jnp.array([0.09, 0.01, 0.0])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder of logs of one drive, well and ill, and the truth."""
    folder = tmp_path_factory.mktemp("recorded")
    world = PolygonMap.from_outlines(ROOM, DESK)
    lidar = Lidar.create(180, noise=0.01)
    poses = [jnp.array([31.0, -8.0, 0.1])]
    for _ in STAMPS[1:]:
        poses.append(geometry.compose(poses[-1], STEP))
    poses = jnp.stack(poses)
    keys = jax.random.split(jax.random.key(0), SCANS)
    exact = jax.vmap(raycast, (None, 0, None))(world, poses, lidar.bearings)
    ranges = np.array(jax.vmap(lidar.measure)(keys, exact).ranges)
    ranges[EMPTY] = 31.0
    way = np.array(jax.vmap(geometry.between, (None, 0))(poses[0], poses), float)
    wheels = way * [1.1, 1.1, 1.0] + [20.0, -3.0, 0.0]  # too large by a tenth
    content = {"ranges": ranges, "bearings": lidar.bearings, "range_max": 30.0}
    np.savez(folder / "log.npz", **content, stamp=STAMPS, odometry=wheels)
    np.savez(folder / "plain.npz", **content)
    np.savez(folder / "dark.npz", **content | {"ranges": np.full_like(ranges, 31.0)})
    np.save(folder / "way.npy", way)
    true = np.array(poses, float)
    write_tum(folder / "truth.tum", STAMPS[::3], true[::3])
    write_tum(folder / "other_times.tum", STAMPS + 1e6, true)
    return folder


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FSMSM_NO_CACHE", "1")


def odometry(folder, *options, log="log.npz"):
    """Run the command on a recorded file; the exit status."""
    return cli.main(["odometry", str(folder / log), *options])


def test_the_way_its_drift_and_all_of_it_kept(recorded, capsys, tmp_path):
    truth = str(recorded / "truth.tum")
    options = ("--tum", "out.tum", "--out", "runs/one", "--reference", truth)
    assert odometry(recorded, *options) == 0
    out = capsys.readouterr().out
    for words in (
        "24 scans of 180 rays",
        "1 skipped, 0 doubted",
        "wheels against scans: ",
        "scans against reference: ",
        "over sub-paths of 1 m",
        "tum       out.tum",
        "picture   runs/one/odometry.png",
    ):
        assert words in out
    stamps, poses = read_tum("out.tum")
    np.testing.assert_allclose(stamps, STAMPS)
    # Two metres at a centimetre of noise, from the lidar's own first pose.
    np.testing.assert_allclose(poses, np.load(recorded / "way.npy"), atol=0.03)

    folder = tmp_path / "runs" / "one"
    assert (folder / "trajectory.tum").read_text() == (tmp_path / "out.tum").read_text()
    assert (folder / "odometry.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((folder / "scans.csv").read_text().splitlines()))
    status = [row["status"] for row in rows]
    assert (status[0], status[EMPTY], len(status)) == ("keyframe", "skipped", SCANS)
    config = json.loads((folder / "config.json").read_text())
    assert config["odometry"]["keyframes"] == 5
    assert {"commit", "begun", "device", "remarks", "log"} <= config.keys()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert sum(metrics["count"].values()) == SCANS
    assert 1.9 < metrics["distance_m"] < 2.2
    ours, wheels = (
        metrics["drift"][f"{one}_against_reference"] for one in ("scans", "wheels")
    )
    assert ours["percent"] < 2 < 9 < wheels["percent"] < 11
    assert metrics["drift"]["wheels_against_scans"]["percent"] == pytest.approx(
        10, abs=2
    )


def test_json_is_all_of_stdout_and_a_log_may_have_scans_only(
    recorded, capsys, tmp_path
):
    assert odometry(recorded, "--json", "--plot", "none", log="plain.npz") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["drift"] == {}
    assert answer["remarks"] == [
        "the log has no times: the trajectory counts scans, from 0"
    ]
    np.testing.assert_allclose(
        answer["last"]["pose"], np.load(recorded / "way.npy")[-1], atol=0.03
    )
    assert not list(tmp_path.iterdir())


def test_a_log_of_nothing_stays_where_it_is(recorded, capsys):
    assert odometry(recorded, log="dark.npz") == 0
    out = capsys.readouterr().out
    assert "24 skipped" in out
    assert "distance  0.0 m" in out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--topic", "/scan"], "only rosbags have topics"),
        (["--plot", "no/a.png"], "no folder no"),
        (["--tum", "no/a.tum"], "no folder no"),
        (["--out", "FULL"], "no empty folder"),
        (["--reference", "none.tum"], "no trajectory"),
        (["--reference", "OTHER"], "no pose at the time of any scan"),
    ],
)
def test_errors_are_one_line_and_status_two(recorded, capsys, options, message):
    files = {"OTHER": str(recorded / "other_times.tum"), "FULL": str(recorded)}
    assert odometry(recorded, *(files.get(word, word) for word in options)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fsmsm: error: ")
    assert message in line
