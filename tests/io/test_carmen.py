import gzip

import numpy as np
import pytest

from fsmsm_jax.io import read_scans
from fsmsm_jax.io.frames import between


def flaser(ranges, stamp=1.5, pose="1 2 0.5", odometry="1 2 0.5"):
    readings = " ".join(f"{r:.2f}" for r in ranges)
    return f"FLASER {len(ranges)} {readings} {pose} {odometry} {stamp} host {stamp}"


def rawlaser(ranges, start=-2.0, step=0.5, largest=8.0):
    readings = " ".join(f"{r:.2f}" for r in ranges)
    head = f"RAWLASER1 0 {start} 4.0 {step} {largest} 0.01 0 {len(ranges)}"
    return f"{head} {readings} 2 7 7 3.25 host 3.5"


def robotlaser(ranges, laser="4 5 0.5", robot="1 2 0.5"):
    scan = rawlaser(ranges).removesuffix("3.25 host 3.5").replace("RAW", "ROBOT")
    return f"{scan}{laser} {robot} 0 0 1 1 1 3.25 host 3.5"


def odom(stamp, pose):
    return f"ODOM {pose} 0 0 0 {stamp} host {stamp}"


def write(path, *lines):
    path.write_text(
        "# a comment\n\nPARAM robot_front_laser_max 50 1 h 1\n" + "\n".join(lines)
    )
    return path


@pytest.mark.parametrize(
    ("rays", "last"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)]
)
def test_flaser_bearings(tmp_path, rays, last):
    log = read_scans(
        write(tmp_path / "a.log", flaser(np.full(rays, 2.0)), "ODOM 1 2 3")
    )
    assert log.ranges.shape == (1, rays)
    np.testing.assert_allclose(np.rad2deg(log.bearings[0, [0, -1]]), [-90, last])
    np.testing.assert_array_equal(log.stamps, [1.5])


@pytest.mark.parametrize(
    ("code", "range_max"),
    [(8.19, 8.18), (50.0, 50.0), (51.2, 50.0), (81.83, 80.0), (81.91, 80.0)],
)
def test_no_echo_code_is_found_in_the_readings(tmp_path, code, range_max):
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0.5, min(code, 30.0), (20, 180)).round(2)
    ranges[rng.random(ranges.shape) < 0.02] = code
    log = read_scans(write(tmp_path / "a.log", *map(flaser, ranges)))
    assert log.range_max == range_max
    scan = log.scan(0)
    assert scan.valid.all()
    np.testing.assert_array_equal(scan.echo, ranges[0] < range_max)


def test_far_readings_without_a_code_stay_echoes(tmp_path):
    ranges = np.linspace(1.0, 40.0, 180)  # passes 8.19 m on its way
    log = read_scans(write(tmp_path / "a.log", flaser(ranges)))
    assert log.range_max == 80.0
    assert log.scan(0).echo.all()


def test_gzip_and_preference_for_flaser(tmp_path):
    path = tmp_path / "a.log.gz"
    text = "\n".join(
        [rawlaser([1, 2, 3]), flaser(np.full(180, 2.0)), flaser(np.full(180, 3.0))]
    )
    path.write_bytes(gzip.compress(text.encode()))
    log = read_scans(path)
    np.testing.assert_array_equal(log.ranges[:, 0], [2, 3])


def test_rawlaser_states_its_rays(tmp_path):
    log = read_scans(write(tmp_path / "a.clf", rawlaser([1.0, 2.0, 8.5])))
    np.testing.assert_array_equal(log.ranges, [[1, 2, 8.5]])
    np.testing.assert_allclose(log.bearings, [[-2.0, -1.5, -1.0]])
    assert log.range_max == 8.0
    np.testing.assert_array_equal(log.stamps, [3.25])
    np.testing.assert_array_equal(log.scan(0).echo, [True, True, False])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], r"holds no scans: .* found \['PARAM'\]"),
        (
            ["L 1 2 3 4 5 6 7 8", "O 1 2 3 4"],
            "expected CARMEN lines that begin with FLASER",
        ),
        ([flaser(np.ones(180))[:400]], "line 4, FLASER: announces 180 readings.* torn"),
        (
            [flaser(np.ones(180)).replace("1.00", "x", 1)],
            "line 4, FLASER: could not convert",
        ),
        ([flaser(np.ones(90))], "not 90: convert the log"),
        (["FLASER"], "line 4, FLASER"),
        ([rawlaser([1, 2, 3])[:40]], "line 4, RAWLASER1"),
        ([" ".join(rawlaser([1, 2, 3]).split()[:-1])], "the log is torn"),
    ],
)
def test_text_that_is_no_log(tmp_path, lines, message):
    with pytest.raises(ValueError, match=message):
        read_scans(write(tmp_path / "a.log", *lines))


def test_gzip_that_holds_nothing(tmp_path):
    path = tmp_path / "text.log.gz"
    path.write_bytes(b"FLASER")
    with pytest.raises(ValueError, match="torn or no gzip"):
        read_scans(path)
    path.write_bytes(gzip.compress(b"FLASER")[:9])
    with pytest.raises(ValueError, match="torn or no gzip"):
        read_scans(path)
    (tmp_path / "empty.log").touch()
    with pytest.raises(ValueError, match="found nothing"):
        read_scans(tmp_path / "empty.log")


def test_torn_gzip_gives_what_can_be_unpacked(tmp_path):
    rows = np.random.default_rng(0).uniform(1, 9, (99, 180)).round(2)
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress("\n".join(map(flaser, rows)).encode())[:-9000])
    log = read_scans(path)
    assert 50 < len(log) < 99
    np.testing.assert_array_equal(log.ranges, rows[: len(log)])
    assert "a.log.gz is torn" in log.remarks[0]
    assert f"breaks off in line {len(log) + 1}: {len(log)} scans" in log.remarks[1]


@pytest.mark.parametrize("line", [flaser(np.ones(180)), robotlaser([1, 2, 3])])
def test_a_log_torn_anywhere_in_its_last_line_keeps_the_others(tmp_path, line):
    for cut in range(len("FLASER 180 1.0") + 20, len(line) - 12, 7):
        log = read_scans(write(tmp_path / "a.log", line, line, line[:cut]))
        assert len(log) == 2
        assert log.remarks[0] == "the log breaks off in line 6: 2 scans were read"


def test_garbage_in_the_middle_is_left_out_unless_it_is_much(tmp_path):
    lines = [flaser(np.full(180, 2.0), stamp) for stamp in range(20)]
    lines[3] = lines[3].replace("2.00", "2.x0", 1)
    lines[7] = lines[7].replace("FLASER 180", "FLASER 99999")
    log = read_scans(write(tmp_path / "a.log", *lines))
    assert len(log) == 18
    assert log.remarks[0].startswith(
        "2 of 20 lines with scans make no sense and were left out; a.log, line 7, FLASER"
    )
    lines[9] = "FLASER"
    with pytest.raises(ValueError, match="line 7, FLASER.*; 3 of 20 lines"):
        read_scans(write(tmp_path / "a.log", *lines))


def test_scans_of_another_ray_count_are_padded(tmp_path):
    lines = [flaser(np.ones(180)), flaser(np.ones(181)), flaser(np.ones(180))]
    log = read_scans(write(tmp_path / "a.log", *lines))
    np.testing.assert_array_equal(log.scans().valid.sum(axis=1), [180, 181, 180])
    np.testing.assert_allclose(log.bearings[:2, 90], 0, atol=1e-9)
    assert log.remarks[0] == (
        "2 of 3 scans have fewer than 181 rays, down to 180, and were padded"
    )


def test_odometry_of_the_laser(tmp_path):
    offset = "PARAM robot_frontlaser_offset -0.5 host 0"
    turned = "1 2 1.57079633"
    line = flaser(np.ones(180), pose="7 7 7", odometry=turned)
    log = read_scans(write(tmp_path / "a.log", offset, line))
    np.testing.assert_allclose(log.odometry, [[1, 1.5, np.pi / 2]], atol=1e-6)
    log = read_scans(write(tmp_path / "a.log", line))
    np.testing.assert_allclose(log.odometry, [[1, 2, np.pi / 2]], atol=1e-6)
    assert not log.remarks

    log = read_scans(write(tmp_path / "a.log", offset, robotlaser([1, 2, 3])))
    np.testing.assert_allclose(log.odometry, [[4, 5, 0.5]])
    np.testing.assert_array_equal(log.stamps, [3.25])

    around = [odom(3.0, "0 0 0"), rawlaser([1, 2, 3]), odom(3.5, "1 0 0"), "ODOM 1"]
    log = read_scans(write(tmp_path / "a.log", offset, *around))
    np.testing.assert_allclose(log.odometry, [[0, 0, 0]], atol=1e-9)
    assert read_scans(write(tmp_path / "a.log", rawlaser([1, 2]))).odometry is None


def test_time_that_steps_back_is_told(tmp_path):
    lines = [flaser(np.ones(180), stamp) for stamp in (1.0, 3.0, 2.0, 2.0)]
    log = read_scans(write(tmp_path / "a.log", *lines))
    np.testing.assert_array_equal(log.stamps, [1, 3, 2, 2])
    assert log.remarks == (
        "time goes backwards 1 times, the order of the file is kept",
        "1 of 4 scans bear the same time as the one before",
    )


def corrected(bridge):
    """A drive of 1 m per step, where SLAM moves and turns each pose."""
    scan = lambda stamp, pose: flaser(np.ones(180), stamp, pose, pose)
    return [
        odom(1.0, "9 9 9"),
        *(scan(1.0, "0 0 0"), "NEFF 1", odom(0, "0 0 0")),
        *(odom(1.5, "0.5 0 0"), odom(2.0, "1 0 0")),
        *(scan(2.0, "5 0 1.57079633"), "NEFF 1", odom(0, "5 0 1.57079633")),
        *([odom(3.0, "5 1 1.67079633")] if bridge else []),
        scan(3.0, "5 2 1.57079633"),
    ]


def test_odometry_of_logs_corrected_by_slam_is_what_lies_between(tmp_path):
    log = read_scans(write(tmp_path / "a.log", *corrected(bridge=True)))
    np.testing.assert_allclose(
        log.odometry, [[0, 0, 0], [1, 0, 0], [2, 0, 0.1]], atol=1e-6
    )
    assert "corrected by SLAM (NEFF lines); odometry was chained" in log.remarks[0]
    log = read_scans(write(tmp_path / "a.log", *corrected(bridge=False)))
    assert log.odometry is None
    assert "ODOM lines do not bridge all scans" in log.remarks[0]


@pytest.mark.parametrize("name", ["intel", "freiburg-079"])
def test_chained_odometry_is_that_of_the_recording(data, name):
    log = read_scans(data / "logs" / "carmen" / f"{name}-corrected.log.gz")
    with np.load(data / "real" / f"{name}_dense.npz") as dense:
        recorded = dense["odom"][dense["gt_anchor_index"]]
    motions = between(log.odometry[:-1], log.odometry[1:])
    expected = between(recorded[:-1], recorded[1:])
    difference = between(expected, motions)
    assert np.abs(difference[:, :2]).max() < 3e-4
    assert np.abs(difference[:, 2]).max() < 3e-5
    assert ("backwards 4 times" in str(log.remarks)) == (name == "intel")


@pytest.mark.parametrize("name", ["intel", "freiburg-079", "csail"])
def test_real_logs_read_as_the_prepared_arrays(data, name):
    log = read_scans(data / "logs" / "carmen" / f"{name}-corrected.log.gz")
    with np.load(data / "real" / f"{name}.npz") as prepared:
        np.testing.assert_allclose(log.ranges, prepared["ranges"], atol=1e-5)
        rays = np.arange(log.ranges.shape[1])
        bearings = prepared["angle_min"] + prepared["angle_increment"] * rays
        np.testing.assert_allclose(log.bearings[0], bearings, atol=1e-9)
        assert log.range_max == prepared["range_no_return"]


def test_cmu_logs_are_refused_with_what_is_supported(data):
    with pytest.raises(ValueError, match=r"expected CARMEN lines.*found \['L', 'O'\]"):
        read_scans(data / "logs" / "robotdata1.log.gz")
    with pytest.raises(ValueError, match="found"):
        read_scans(data / "logs" / "maebot_convex.lcm.log")
