import csv
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import cli, slam
from fsmsm_jax.cli import legs
from fsmsm_jax.cli.slam_report import remarks_on
from fsmsm_jax.io import LandmarkLog, read_tum
from fsmsm_jax.io.drive_npz import write_drive_npz

CAR = slam.Car(noise=(0.2, 0.02))
SENSOR = slam.RangeBearing(noise=(0.05, 0.01), reach=40.0)
PLACES = np.array([[38.0, 7.0], [36.0, -4.0], [44.0, 9.0], [47.0, -3.0], [49.0, 6.0]])
STEPS, SECONDS, SPEED = 13, 0.25, 2.0
TIMES = 100.0 + SECONDS * np.arange(STEPS)
START = np.array([30.0, 1.0, 0.1])
FEW = ("--particles", "3")


@pytest.fixture(scope="module")
def log():
    """A car goes straight towards five landmarks, away from the origin."""
    rng = np.random.default_rng(0)
    gone = SPEED * (TIMES - TIMES[0])[:, None]
    ways = START[:2] + gone * [np.cos(START[2]), np.sin(START[2])]
    x, y = np.moveaxis(PLACES - ways[:, None], -1, 0)
    exact = np.stack([np.hypot(x, y), np.arctan2(y, x) - START[2]], axis=-1)
    controls = np.tile([SPEED, 0.0, SECONDS / 2], (STEPS, 2, 1))
    controls[..., :2] += CAR.noise * rng.normal(size=(STEPS, 2, 2))
    controls[0, :, 2] = 0.0
    ids = np.tile(np.arange(len(PLACES)), (STEPS, 1))
    seen = exact + SENSOR.noise * rng.normal(size=exact.shape)
    return LandmarkLog(
        slam.tidied(controls, seen, ids=ids),
        TIMES,
        START,
        CAR,
        SENSOR,
        np.column_stack([TIMES, ways]),
        landmarks=PLACES,
    )


@pytest.fixture(scope="module")
def recorded(log, tmp_path_factory):
    """Folder of that log, whole and with less in it."""
    folder = tmp_path_factory.mktemp("recorded")
    write_drive_npz(folder / "log.npz", log)
    bare = log._replace(reference=np.zeros((0, 3)), landmarks=None)
    write_drive_npz(folder / "bare.npz", bare)
    unknown = log.drive._replace(ids=np.full_like(log.drive.ids, -1))
    robot = log._replace(drive=unknown, vehicle=slam.DiffDrive())
    write_drive_npz(folder / "robot.npz", robot)
    (folder / "empty").mkdir()
    return folder


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FSMSM_NO_CACHE", "1")


def run(folder, *options, log="log.npz"):
    """Run the command on a recorded file; the exit status."""
    return cli.main(["slam", str(folder / log), *FEW, *options])


def test_the_way_the_map_and_all_of_it_kept(recorded, log, capsys, tmp_path):
    options = ("--ids", "--landmarks", "7", "--trim", "1", "0", "--tum", "out.tum")
    assert run(recorded, *options, "--out", "runs/one") == 0
    out = capsys.readouterr().out
    for words in (
        "13 looks in 3 s, 65 detections, of 5 landmarks by its ids",
        "slam      lslam2: 5 landmarks on the map; ",
        "particles 3, of which ",
        "steps/s with 7 slots",
        "; 13 fixes",
        "5 of 5 landmarks found, 0 more that are none",
        "tum       out.tum",
        "picture   runs/one/slam.png",
    ):
        assert words in out
    assert "remark" not in out
    stamps, poses = read_tum("out.tum")
    np.testing.assert_allclose(stamps, log.times)
    # Six metres among landmarks that are seen to 5 cm and, at ten metres, 10 cm.
    np.testing.assert_allclose(poses[:, :2], log.reference[:, 1:], atol=0.2)
    np.testing.assert_allclose(poses[:, 2], START[2], atol=0.03)

    folder = tmp_path / "runs" / "one"
    assert (folder / "trajectory.tum").read_text() == (tmp_path / "out.tum").read_text()
    assert (folder / "slam.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((folder / "map.csv").read_text().splitlines()))
    assert [row["landmark"] for row in rows] == list("01234")
    places = np.array([[row["x_m"], row["y_m"]] for row in rows], float)
    np.testing.assert_allclose(places, PLACES, atol=0.5)
    sigmas = np.array([[row["sigma_x_m"], row["sigma_y_m"]] for row in rows], float)
    assert np.all((sigmas > 0.005) & (sigmas < 0.2))
    rows = list(csv.DictReader((folder / "steps.csv").read_text().splitlines()))
    assert [row["step"] for row in rows] == [str(n) for n in range(STEPS)]
    assert {(row["detections"], row["explained"]) for row in rows} == {("5", "True")}
    config = json.loads((folder / "config.json").read_text())
    assert config["slam"]["association"] is None
    assert config["slam"]["vehicle"]["trim"] == [1.0, 0.0]
    assert config["slam"]["sensor"]["noise"] == [0.05, 0.01]
    assert {"seed", "start", "commit", "begun", "device", "log"} <= config.keys()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["steps"] == STEPS
    assert 5.5 < metrics["distance_m"] < 6.5
    assert metrics["reference"]["aligned_rms_m"] <= metrics["reference"]["rms_m"] < 0.2
    assert metrics["survey"]["rms_m"] < 0.3


def test_json_is_all_of_stdout_and_a_log_may_know_nothing_of_the_truth(
    recorded, capsys, tmp_path
):
    options = ("--ids", "--landmarks", "7", "--json", "--plot", "none")
    assert run(recorded, *options, log="bare.npz") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["landmarks"], answer["remarks"]) == (5, [])
    assert answer["reference"] is answer["survey"] is None
    assert not list(tmp_path.iterdir())


def test_a_newcomer_needs_no_log(capsys):
    assert cli.main(["slam", "--particles", "6", "--seed", "3"]) == 0
    out = capsys.readouterr().out
    assert "log       simulated out of seed 3: 420 looks in 84 s" in out
    assert "25 of 25 landmarks found, 0 more that are none" in out
    assert "with 64 slots" in out
    assert "picture   slam.png" in out
    assert "remark" not in out
    # Two laps of a circle of 20 m.
    distance = float(re.search(r"distance  (.*) m\n", out)[1])
    assert distance == pytest.approx(4 * np.pi * 20, abs=5)


def test_what_is_odd_is_told(log):
    late = log._replace(reference=log.reference + [1e6, 0.0, 0.0])
    numbers = {"slots": 12, "detections": 70, "landmarks": 12, "reference": None}
    numbers |= {"unplaced": 39, "unexplained_steps": 2}
    slots, steps, ids, reference = remarks_on(late, numbers, ids=False)
    assert "39 detections of new landmarks found all 12 slots taken" in slots
    assert steps == "in 2 steps no particle explains what was detected"
    assert "12 landmarks where the log tells 5 apart: --ids" in ids
    assert reference == "no place of the reference is of the time of the drive"
    quiet = numbers | {"unplaced": 0, "unexplained_steps": 0, "reference": {}}
    assert remarks_on(log, quiet, ids=True) == [
        "5 detections have no id and were left alone"
    ]


def test_legs_that_grow_end_where_one_run_ends(log, monkeypatch):
    """13 steps in 3 legs of 5: two of nothing before; 5 landmarks in 3 slots, then 6.

    The filter draws nothing, so the steps before do not change what it draws.
    """
    rules = slam.Association(drawn=False)
    few = slam.SlamConfig("ekf", 1, 3, CAR, SENSOR, rules)
    many = slam.SlamConfig("ekf", 1, 6, CAR, SENSOR, rules)
    state = slam.init(many, jax.random.key(0), jnp.asarray(log.start))
    state, info = slam.run(many, state, log.drive)

    monkeypatch.setattr(legs, "_LEG", 5)
    driven = legs.drive_through(few, log, 0, grow=True)
    assert len(driven.landmarks.known) == 6
    # Two programs, one order of sums each: some units in the last place of 50 m.
    np.testing.assert_allclose(driven.info.pose, info.pose, atol=1e-4)
    np.testing.assert_allclose(driven.info.covariance, info.covariance, atol=1e-6)
    np.testing.assert_array_equal(driven.info.known, info.known)
    end = jax.tree.map(lambda a: a[0], state.particles.landmarks)
    assert int(end.known.sum()) == 5
    for ours, theirs in zip(
        jax.tree.leaves(driven.landmarks), jax.tree.leaves(end), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize(
    ("file", "options", "message"),
    [
        ("none.npz", [], "there is no log at"),
        ("empty", [], "cannot tell what"),
        ("robot.npz", ["--ids"], "does not say which landmarks"),
        ("robot.npz", ["--trim", "1", "0"], "this vehicle has none"),
        ("log.npz", ["--trim", "nan", "0"], "two finite numbers"),
        ("log.npz", ["--landmarks", "0"], "at least one particle and one landmark"),
        ("log.npz", ["--plot", "no/a.png"], "no folder no"),
        ("log.npz", ["--tum", "no/a.tum"], "no folder no"),
        ("log.npz", ["--out", "FULL"], "no empty folder"),
    ],
)
def test_errors_are_one_line_and_status_two(recorded, capsys, file, options, message):
    words = [str(recorded) if word == "FULL" else word for word in options]
    assert run(recorded, *words, log=file) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fsmsm: error: ")
    assert message in line


@pytest.mark.slow
def test_the_car_park(data, capsys):
    log = str(data / "slam" / "carpark")
    assert cli.main(["slam", log, "--json", "--plot", "none"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["survey"]["missing"], answer["survey"]["extra"]) == (0, 0)
    # To GPS: 0.22 m with seed 0, and the goal's prototype had 0.21 ± 0.03 m.
    assert answer["reference"]["rms_m"] < 0.3
