import gzip

import numpy as np
import pytest

from fsmsm_jax.io import read_scans


def flaser(ranges, stamp=1.5):
    readings = " ".join(f"{r:.2f}" for r in ranges)
    return f"FLASER {len(ranges)} {readings} 1 2 0.5 1 2 0.5 {stamp} host {stamp}"


def rawlaser(ranges, start=-2.0, step=0.5, largest=8.0):
    readings = " ".join(f"{r:.2f}" for r in ranges)
    head = f"RAWLASER1 0 {start} 4.0 {step} {largest} 0.01 0 {len(ranges)}"
    return f"{head} {readings} 2 7 7 3.25 host 3.5"


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
        (
            [flaser(np.ones(180)), flaser(np.ones(181))],
            r"mixes scans of \[180, 181\] rays",
        ),
        (["FLASER"], "line 4, FLASER"),
        ([rawlaser([1, 2, 3])[:40]], "line 4, RAWLASER1"),
        ([" ".join(rawlaser([1, 2, 3]).split()[:-1])], "the log is torn"),
    ],
)
def test_text_that_is_no_log(tmp_path, lines, message):
    with pytest.raises(ValueError, match=message):
        read_scans(write(tmp_path / "a.log", *lines))


def test_torn_gzip(tmp_path):
    whole = gzip.compress("\n".join([flaser(np.linspace(1, 9, 180))] * 9).encode())
    for name, content in (
        ("cut", whole[:-30]),
        ("text", b"FLASER"),
        ("broken", whole[:20] + b"x" * 200),
    ):
        path = tmp_path / f"{name}.log.gz"
        path.write_bytes(content)
        with pytest.raises(ValueError, match="torn or no gzip"):
            read_scans(path)
    (tmp_path / "empty.log").touch()
    with pytest.raises(ValueError, match="found nothing"):
        read_scans(tmp_path / "empty.log")


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
