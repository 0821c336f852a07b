import csv
import json
import re
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import cli, geometry
from fsmsm_jax.io import read_tum
from fsmsm_jax.localisation import AtlasConfig, build_atlas
from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world.buildings import office
from fsmsm_jax.world.ros_map import save_map

command = import_module("fsmsm_jax.cli.track")
STEP = jnp.array([0.08, 0.01, 0.05])
EMPTY = 5  # the scan in which nothing is to be seen
STAMPS = 100.0 + 0.2 * np.arange(12)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Folder of a small map, its atlas, and logs of one drive, well and ill."""
    folder = tmp_path_factory.mktemp("recorded")
    world = office(seed=1, width=15.0, height=10.0)
    lidar = Lidar.create(180, noise=0.01)
    poses = [jnp.array([7.5, 4.0, -0.5])]
    for _ in STAMPS[1:]:
        poses.append(geometry.compose(poses[-1], STEP))
    poses = jnp.stack(poses)
    assert bool(world.contains(poses[:, :2]).all())
    see = jax.vmap(
        lambda key, pose: lidar.measure(key, raycast(world, pose, lidar.bearings))
    )
    ranges = np.array(
        see(jax.random.split(jax.random.key(0), len(poses)), poses).ranges
    )
    ranges[EMPTY] = 31.0
    save_map(world, folder / "map.yaml")
    build_atlas(world, AtlasConfig(spacing=0.5)).save(folder / "map.atlas.npz")
    away = jnp.array([20.0, -3.0, 2.0])
    odometry = np.array(jax.vmap(geometry.compose, (None, 0))(away, poses))
    content = {"ranges": ranges, "bearings": lidar.bearings, "range_max": 30.0}
    timed = content | {"stamp": STAMPS}
    np.savez(folder / "log.npz", **timed, odometry=odometry)
    np.savez(folder / "plain.npz", **content)
    np.savez(folder / "swept.npz", **timed, time_increment=5e-4)
    odometry[3:6] = np.nan
    np.savez(folder / "holes.npz", **timed, odometry=odometry)
    np.savez(folder / "dark.npz", **timed | {"ranges": np.full_like(ranges, 31.0)})
    stamps = np.where(np.arange(12) == 2, np.nan, STAMPS)
    np.savez(folder / "timeless.npz", **content, stamp=stamps)
    np.save(folder / "truth.npy", poses)
    return folder


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FSMSM_NO_CACHE", "1")


def track(folder, *options, log="log.npz"):
    """Run the command on recorded files; the exit status."""
    files = [str(folder / "map.yaml"), str(folder / log)]
    atlas = ["--atlas", str(folder / "map.atlas.npz")]
    return cli.main(["track", *files, *atlas, *options])


def initial(folder, off=0.0):
    x, y, theta = np.load(folder / "truth.npy")[0]
    return ["--initial", f"{x + off:.4f}", f"{y:.4f}", f"{np.rad2deg(theta):.3f}"]


def near_the_truth(folder, poses, rows, atol=0.05):
    return np.testing.assert_allclose(
        poses, np.load(folder / "truth.npy")[rows], atol=atol
    )


def test_found_followed_and_all_of_it_kept(recorded, capsys, tmp_path):
    assert track(recorded, "--tum", "out.tum", "--out", "runs/one") == 0
    captured = capsys.readouterr()
    assert "12/12" in captured.err
    for words in (
        "log       ",
        "12 of 12 scans: 10 tracked, 1 found on the whole map, 1 skipped, 0 doubted, 0 lost",
        "at scan 0; never lost",
        "step      median",
        "tum       out.tum",
        "picture   runs/one/track.png",
    ):
        assert words in captured.out
    assert 0.5 < float(re.search(r"distance  (\S+) m", captured.out)[1]) < 1.0
    assert not (tmp_path / "track.png").exists()

    stamps, poses = read_tum("out.tum")
    np.testing.assert_allclose(stamps, STAMPS)
    near_the_truth(recorded, poses, slice(None))
    folder = tmp_path / "runs" / "one"
    assert (folder / "trajectory.tum").read_text() == (tmp_path / "out.tum").read_text()
    assert (folder / "track.png").read_bytes().startswith(b"\x89PNG")

    rows = list(csv.DictReader((folder / "fixes.csv").read_text().splitlines()))
    status = [row["status"] for row in rows]
    assert status[0] == "localised"
    assert status[EMPTY] == "skipped"
    assert all(0 < float(row["sigma_x_m"]) < 0.1 for row in rows)
    place = [
        [float(row[name]) for name in ("x_m", "y_m", "heading_rad")] for row in rows
    ]
    np.testing.assert_allclose(place, poses, atol=2e-6)

    config = json.loads((folder / "config.json").read_text())
    assert config["map"] == str(recorded / "map.yaml")
    assert config["follow"]["tracker"]["odometry"]["turn_per_turn"] == 0.1
    assert config["atlas"]["spacing"] == 0.5
    assert config["versions"]["jax"] == jax.__version__
    assert {"commit", "begun", "device", "remarks", "sweep"} <= config.keys()
    metrics = json.loads((folder / "metrics.json").read_text())
    others = {"doubted": 0, "localised": 1, "lost": 0}
    assert metrics["count"] == {"tracking": 10, "skipped": 1} | others
    assert sum(metrics["share"].values()) == pytest.approx(1.0)
    assert metrics["localised_at"] == [0]
    assert 0 < metrics["step_ms"]["median"] <= metrics["step_ms"]["p99"]
    assert metrics["compiling"]["scans"] >= 1
    near_the_truth(recorded, metrics["last"]["pose"], -1)


def test_json_is_all_of_stdout(recorded, capsys, tmp_path):
    options = (*initial(recorded, 0.05), "--json", "--plot", "none")
    assert track(recorded, *options, log="holes.npz") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["scans"] == answer["computed"] == 12
    assert answer["localised_at"] == []
    assert answer["remarks"] == ["3 of 12 scans have no odometry at their time"]
    near_the_truth(recorded, answer["last"]["pose"], -1)
    assert not list(tmp_path.iterdir())


def test_odometry_may_be_ignored_and_times_may_be_missing(recorded, capsys):
    start = initial(recorded)
    assert track(recorded, *start, "--no-odometry", "--tum", "a.tum") == 0
    assert "12 scans of 180 rays, 2 s, no odometry" in capsys.readouterr().out
    assert track(recorded, *start, "--tum", "b.tum", log="plain.npz") == 0
    out = capsys.readouterr().out
    assert "remark    the log has no times: the trajectory counts scans" in out
    (_, with_times), (counted, without) = read_tum("a.tum"), read_tum("b.tum")
    np.testing.assert_allclose(counted, np.arange(12))
    np.testing.assert_allclose(with_times, without, atol=1e-6)
    near_the_truth(recorded, without, slice(None), atol=0.08)


def test_a_scan_without_a_time_is_left_out_of_the_trajectory(recorded, capsys):
    assert (
        track(recorded, *initial(recorded), "--tum", "a.tum", log="timeless.npz") == 0
    )
    assert "1 of 12 scans have no time" in capsys.readouterr().out
    np.testing.assert_allclose(read_tum("a.tum")[0], np.delete(STAMPS, 2))


def breaks_after(scans, error):
    """Readings that end in an error instead of a scan."""

    def stacked(*arguments):
        readings = command_stacked(*arguments)
        for _ in range(scans):
            yield next(readings)
        raise error

    return stacked


command_stacked = command.stacked


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ValueError("the log breaks off"), 2, "fsmsm: error: the log breaks off"),
        (KeyboardInterrupt(), 130, "fsmsm: interrupted"),
    ],
)
def test_what_was_computed_is_kept(recorded, capsys, monkeypatch, error, status, line):
    monkeypatch.setattr(command, "stacked", breaks_after(4, error))
    assert track(recorded, "--tum", "out.tum", "--out", "run") == status
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1] == line
    assert "4 of 12 scans: 3 tracked" in captured.out
    stamps, poses = read_tum("out.tum")
    np.testing.assert_allclose(stamps, STAMPS[:4])
    near_the_truth(recorded, poses, slice(4))
    assert len(read_tum("run/trajectory.tum")[0]) == 4
    with open("run/fixes.csv") as file:
        assert len(file.readlines()) == 1 + 4
    with open("run/metrics.json") as file:
        assert json.load(file)["computed"] == 4
    with open("run/track.png", "rb") as file:
        assert file.read(4) == b"\x89PNG"


def test_each_line_is_on_the_disk_before_the_next_scan(recorded, monkeypatch):
    written = []

    def stacked(*arguments):
        for reading in command_stacked(*arguments):
            written.append(len(read_tum("out.tum")[0]))
            yield reading

    monkeypatch.setattr(command, "stacked", stacked)
    options = ("--tum", "out.tum", "--plot", "none")
    assert track(recorded, *initial(recorded), *options) == 0
    assert written == list(range(12))


def test_a_log_of_nothing_is_lost_and_no_error(recorded, capsys):
    assert track(recorded, "--out", "run", log="dark.npz") == 0
    out = capsys.readouterr().out
    assert "12 lost" in out
    assert "never; is this the map of the place?" in out
    assert not read_tum("run/trajectory.tum")[0].size


def test_an_error_before_the_first_scan_draws_nothing(recorded, capsys, monkeypatch):
    monkeypatch.setattr(
        command, "stacked", breaks_after(0, ValueError("nothing there"))
    )
    assert track(recorded, "--plot", "a.png", "--tum", "a.tum") == 2
    assert not read_tum("a.tum")[0].size
    assert "0 of 12 scans" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--initial", "70", "4", "40"], "off the map or inside a wall"),
        (["--initial", "nan", "4", "40"], "three finite numbers"),
        (["--initial", "7.5", "4", "45", "--global"], "contradict each other"),
        (["--topic", "/scan"], "only rosbags have topics"),
        (["--odometry-topic", "/odom"], "only rosbags have topics"),
        (["--sweep", "stated"], "does not say when its rays were taken"),
        (["--sweep", "reversed"], "does not say when its rays were taken"),
        (["--plot", "no/a.png"], "no folder no"),
        (["--tum", "no/a.tum"], "no/a.tum"),
        (["--out", "FULL"], "no empty folder"),
        (["--atlas", "LOG"], "cannot read a scan atlas"),
    ],
)
def test_errors_are_one_line_and_status_two(recorded, capsys, options, message):
    files = {"LOG": str(recorded / "log.npz"), "FULL": str(recorded)}
    assert track(recorded, *(files.get(word, word) for word in options)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fsmsm: error: ")
    assert message in line


def test_compensation_without_odometry_would_swing(recorded, capsys):
    assert track(recorded, "--sweep", "stated", log="swept.npz") == 2
    assert "needs odometry" in capsys.readouterr().err


def test_localise_tells_what_is_odd_about_a_log(recorded, capsys):
    files = [str(recorded / "map.yaml"), str(recorded / "holes.npz")]
    for options in (["localise"], ["match", *initial(recorded)]):
        name, *rest = options
        assert cli.main([name, *files, *rest, "--index", "99"]) == 2
        first, *_ = capsys.readouterr().err.splitlines()
        assert first == "remark    3 of 12 scans have no odometry at their time"
