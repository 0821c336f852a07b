import sys

import numpy as np
import pytest

from fsmsm_jax.io import read_scans
from tests.io.bags import (
    FORMATS,
    SCAN,
    about_z,
    odometry,
    scan,
    transforms,
    write_bag,
)

ROWS = [[1.0, 2.0, np.inf, 4.0], [0.1, np.nan, 3.0]]
FLAT = (0.0, 0.0, 0.0, 1.0)


def scans(rows, topic="/scan", **fields):
    return [(topic, scan(100.5 + i, row, **fields)) for i, row in enumerate(rows)]


@pytest.mark.parametrize(("name", "storage"), FORMATS)
def test_every_kind_of_bag(tmp_path, name, storage):
    path = write_bag(tmp_path / name, scans(ROWS), storage)
    paths = [path, *path.glob("*.mcap"), *path.glob("*.db3")]
    assert len(paths) == (1 if name == "a.bag" else 2)
    for path in paths:
        log = read_scans(path)
        np.testing.assert_array_equal(log.ranges[0], ROWS[0])
        np.testing.assert_allclose(log.ranges[1], [*ROWS[1], np.nan], atol=1e-6)
        np.testing.assert_allclose(log.bearings, [[-1.0, -0.5, 0.0, 0.5]] * 2)
        assert (log.range_min, log.range_max) == (0.25, 12.0)
        np.testing.assert_array_equal(log.stamps, [100.5, 101.5])
        assert log.odometry is None
        assert log.ray_times is None
        assert log.remarks == (
            "1 of 2 scans have fewer than 4 rays, down to 3, and were padded",
        )
        np.testing.assert_array_equal(log.scan(1).valid, [False, False, True, False])


def test_topics_are_asked_for(tmp_path):
    messages = [
        *scans(ROWS, "/front"),
        *scans(ROWS[:1], "/rear"),
        ("/wheels/odom", odometry(100.0, (1.0, 0.0, 0.0), "laser")),
        ("/fused", odometry(100.0, (2.0, 0.0, 0.0), "laser")),
        ("/wheels/odom", odometry(100.5, (1.0, 0.0, 0.0), "laser")),
        ("/fused", odometry(100.5, (2.0, 0.0, 0.0), "laser")),
    ]
    path = write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(ValueError, match=r"choose one of \['/front', '/rear'\]"):
        read_scans(path)
    with pytest.raises(ValueError, match="no scans on /scan, only on"):
        read_scans(path, topic="/scan")
    with pytest.raises(
        ValueError, match=r"no odometry on /o, only on \['/fused', '/wheels/odom'\]"
    ):
        read_scans(path, "/rear", "/o")
    log = read_scans(path, "/rear")
    assert len(log) == 1
    np.testing.assert_allclose(log.odometry, [[1, 0, 0]])
    assert "/wheels/odom is used" in log.remarks[0]
    log = read_scans(path, "/rear", "/fused")
    np.testing.assert_allclose(log.odometry, [[2, 0, 0]])
    assert not log.remarks


def test_bags_without_scans(tmp_path):
    path = write_bag(tmp_path / "none.bag", [])
    with pytest.raises(ValueError, match="holds no sensor_msgs/msg/LaserScan"):
        read_scans(path)
    path = write_bag(tmp_path / "silent.bag", [("/scan", (SCAN, 0.0, None))])
    with pytest.raises(ValueError, match="holds none"):
        read_scans(path)
    with pytest.raises(ValueError, match="are empty"):
        read_scans(write_bag(tmp_path / "empty.bag", scans([[]])))


@pytest.mark.parametrize(("name", "storage"), FORMATS)
def test_odometry_of_the_lidar_at_the_stamps_of_the_scans(tmp_path, name, storage):
    messages = [
        ("/tf_static", transforms(0, ("base_link", "mast", (0.5, 0, 1), FLAT))),
        (
            "/tf_static",
            transforms(0, ("/mast", "/laser", (0, 0, 0), about_z(np.pi / 2))),
        ),
        ("/tf_static", transforms(0, ("footprint", "base_link", (0, 0, 0.1), FLAT))),
        ("/odom", odometry(101.25, (2.0, 1.0, -3.0), "footprint")),
        ("/odom", odometry(100.3, (0.0, 1.0, 0.0), "footprint")),
        ("/odom", odometry(100.7, (1.0, 1.0, 0.0), "footprint")),
        ("/odom", odometry(100.6, (np.nan, 1.0, 0.0), "footprint")),
        ("/odom", odometry(101.75, (2.0, 1.0, 3.0), "footprint")),
        *scans([ROWS[0]] * 3),
    ]
    log = read_scans(write_bag(tmp_path / name, messages, storage))
    expected = [[1.0, 1.0, np.pi / 2], [1.5, 1.0, -np.pi / 2], [np.nan] * 3]
    np.testing.assert_allclose(log.odometry, expected, atol=1e-6)
    assert log.remarks == (
        "1 of 5 odometry messages hold no pose and were left out",
        "1 of 3 scans have no odometry at their time",
    )


def test_transforms_serve_where_no_topic_does(tmp_path):
    edges = lambda x: [
        ("odom", "elsewhere", (9.0, x, 0), FLAT),
        ("odom", "base", (x, 0, 0), FLAT),
        ("base", "laser", (0.25, 0, 0), FLAT),
        ("base", "wheel", (0, 0, 0), about_z(x)),
    ]
    messages = [
        ("/tf", transforms(100.4, *edges(1.0))),
        ("/tf", transforms(100.6, *edges(2.0))),
        *scans(ROWS[:1]),
    ]
    log = read_scans(write_bag(tmp_path / "a.bag", messages))
    np.testing.assert_allclose(log.odometry, [[1.75, 0, 0]], atol=1e-6)
    assert not log.remarks


def test_a_lidar_mounted_upside_down_is_mirrored(tmp_path):
    over = (1.0, 0.0, 0.0, 0.0)  # half a turn about x
    messages = [
        ("/tf_static", transforms(0, ("base", "laser", (0.5, 0, 0), over))),
        ("/odom", odometry(100.5, (1.0, 0.0, 0.0), "base")),
        *scans(ROWS[:1]),
    ]
    log = read_scans(write_bag(tmp_path / "a.bag", messages))
    np.testing.assert_allclose(log.bearings, [[1.0, 0.5, 0.0, -0.5]])
    np.testing.assert_allclose(log.odometry, [[1.5, 0, 0]])
    assert log.remarks == (
        "the lidar is mounted upside down, its bearings were negated",
    )


def test_a_lidar_that_looks_up_is_refused(tmp_path):
    up = (0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4))
    messages = [
        ("/tf_static", transforms(0, ("base", "laser", (0, 0, 0), up))),
        *scans(ROWS[:1]),
    ]
    path = write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(ValueError, match="laser is tilted by 90° against base"):
        read_scans(path)


def test_a_lidar_of_unknown_mounting_sits_at_the_base(tmp_path):
    broken = (0.0, 0.0, 0.0, 0.0)
    messages = [
        ("/odom", odometry(100.5, (1.0, 2.0, 0.5), "base")),
        ("/tf_static", transforms(0, ("base", "laser", (0.5, 0, 0), broken))),
        *scans(ROWS[:1]),
    ]
    log = read_scans(write_bag(tmp_path / "a.bag", messages))
    np.testing.assert_allclose(log.odometry, [[1, 2, 0.5]], atol=1e-9)
    assert "no static transform leads from base to laser" in log.remarks[0]


def test_layout_and_limits_that_change_mid_log(tmp_path):
    messages = [
        ("/scan", scan(1.0, [1.0, 2.0, 3.0])),
        ("/scan", scan(2.0, [1.0, 2.0], angle_min=0.5, angle_increment=-0.25)),
        ("/scan", scan(2.0, [1.0, 2.0, 3.0], angle_min=np.nan, range_max=np.nan)),
        ("/scan", scan(1.5, [1.0, 2.0, 9.0], range_max=8.0, range_min=0.5)),
        ("/scan", scan(0.0, [1.0, 2.0, 3.0], time_increment=0.125)),
    ]
    log = read_scans(write_bag(tmp_path / "a.bag", messages))
    np.testing.assert_allclose(log.bearings[0], [-1, -0.5, 0])
    np.testing.assert_allclose(log.bearings[1], [0.5, 0.25, 0])
    assert not log.scans().valid[2].any()
    assert (log.range_min, log.range_max) == (0.5, 8.0)
    np.testing.assert_array_equal(log.ray_times[[0, 4]], [[0, 0, 0], [0, 0.125, 0.25]])
    assert log.stamps[4] == pytest.approx(4e-9)  # unstamped: when it was recorded
    assert log.remarks == (
        "1 of 5 scans do not say where their rays point and were emptied",
        "1 of 5 scans have fewer than 3 rays, down to 2, and were padded",
        "the directions of the rays change 1 times, each scan has its own",
        "the range limits change, 0.5 to 8 m are taken",
        "time goes backwards 2 times, the order of the file is kept",
        "1 of 5 scans bear the same time as the one before",
    )


def test_a_log_without_limits_takes_those_of_scan(tmp_path):
    path = write_bag(tmp_path / "a.bag", scans(ROWS, range_max=np.inf))
    log = read_scans(path)
    assert log.range_max == 30.0
    assert "no scan states its largest range" in log.remarks[1]


@pytest.mark.parametrize(("name", "storage"), FORMATS)
def test_a_bag_that_breaks_off_gives_what_there_is(tmp_path, name, storage):
    rng = np.random.default_rng(0)
    rows = rng.uniform(1, 9, (400, 360)).astype(np.float32)
    messages = [
        ("/tf_static", transforms(0, ("base", "laser", (0.5, 0, 0), FLAT))),
        *(
            message
            for i, row in enumerate(rows)
            for message in (
                ("/odom", odometry(i + 1.0, (i, 0.0, 0.0), "base")),
                ("/scan", scan(i + 1.0, row)),
            )
        ),
    ]
    path = write_bag(tmp_path / name, messages, storage)
    content = next(path.glob("*.[dm]*[3p]")) if path.is_dir() else path
    whole = content.read_bytes()
    content.write_bytes(whole[: len(whole) * 7 // 10])
    for torn in {path, content}:
        log = read_scans(torn)
        assert 200 < len(log) < 300
        np.testing.assert_array_equal(log.ranges, rows[: len(log)])
        np.testing.assert_allclose(log.odometry[:, 0], np.arange(len(log)) + 0.5)
        assert "the bag is damaged" in log.remarks[0]


def test_a_folder_whose_recorder_died_before_the_metadata(tmp_path):
    path = write_bag(tmp_path / "folder", scans(ROWS))
    (path / "metadata.yaml").unlink()
    log = read_scans(path)
    np.testing.assert_array_equal(log.ranges[0], ROWS[0])
    assert "2 scans could be read" in log.remarks[0]


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_compressed_chunks_of_a_torn_bag(tmp_path, compression):
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    create = rosbag1.Writer.__init__
    with pytest.MonkeyPatch.context() as patch:

        def compressed(self, path):
            create(self, path)
            self.set_compression(rosbag1.Writer.CompressionFormat[compression])

        patch.setattr(rosbag1.Writer, "__init__", compressed)
        path = write_bag(tmp_path / "a.bag", scans(ROWS))
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.rindex(b"op=\x06")])
    np.testing.assert_array_equal(read_scans(path).ranges[0], ROWS[0])


def test_torn_bags(tmp_path):
    for name, storage in (("a.bag", ""), ("sql", "sqlite3"), ("cap", "mcap")):
        path = write_bag(tmp_path / name, scans(ROWS), storage)
        content = next(path.glob("*.[dm]*[3p]")) if path.is_dir() else path
        content.write_bytes(content.read_bytes()[:150])
        for torn in {path, content}:
            with pytest.raises(ValueError, match="no readable rosbag"):
                read_scans(torn)
    (tmp_path / "nothing").mkdir()
    with pytest.raises(ValueError, match="no readable rosbag"):
        read_scans(tmp_path / "nothing")


def test_garbage_between_messages_is_left_out_and_counted(tmp_path):
    path = write_bag(tmp_path / "a.bag", scans([*ROWS, ROWS[0]]))
    whole = path.read_bytes()
    count = np.uint32(len(ROWS[0])).tobytes() + np.float32(ROWS[0]).tobytes()
    huge = np.uint32(10**6).tobytes() + np.float32(ROWS[0]).tobytes()
    path.write_bytes(whole.replace(count, huge, 1))
    log = read_scans(path)
    assert len(log) == 2
    assert log.remarks[0] == "1 of 3 messages are garbage and were left out"


def test_without_rosbags_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    (tmp_path / "a.bag").touch()
    with pytest.raises(ImportError, match=r"pip install 'fsmsm-jax\[ros\]'"):
        read_scans(tmp_path / "a.bag")


def test_real_bag_reads_as_the_prepared_arrays(data):
    pytest.importorskip("rosbags")
    log = read_scans(data / "logs" / "rosbag2_macfirst_floor_take_2")
    with np.load(data / "real" / "mac_turtlebot4_take2.npz") as prepared:
        np.testing.assert_array_equal(log.ranges, prepared["ranges"])
        np.testing.assert_allclose(log.stamps, prepared["stamp"], atol=1e-6)
        assert log.range_max == prepared["range_max"]
        assert log.range_min == prepared["range_min"]
        known = np.isfinite(log.odometry).all(axis=1)
        assert known.sum() == len(log) - 3  # before the first and after the last
        np.testing.assert_allclose(
            log.odometry[known], prepared["odom_laser"][known], atol=1e-4
        )
        np.testing.assert_allclose(
            log.ray_times[:, 1], prepared["time_increment"], rtol=0.2
        )
    assert log.remarks == ("3 of 357 scans have no odometry at their time",)
    assert log.scan(0).echo.sum() > 360
