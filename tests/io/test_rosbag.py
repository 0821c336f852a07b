import sys

import numpy as np
import pytest

from fsmsm_jax.io import read_scans

TYPE = "sensor_msgs/msg/LaserScan"


def write_bag(path, topics, storage="sqlite3"):
    """Write {topic: rows of ranges} as a bag of the kind that the path says."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    types = store.types
    writer = (
        rosbag1.Writer(path)
        if one
        else rosbag2.Writer(
            path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()]
        )
    )
    serialize = store.serialize_ros1 if one else store.serialize_cdr
    with writer:
        for topic, rows in topics.items():
            connection = writer.add_connection(topic, TYPE, typestore=store)
            for number, ranges in enumerate(rows):
                stamp = types["builtin_interfaces/msg/Time"](
                    sec=100 + number, nanosec=500_000_000
                )
                header = {"stamp": stamp, "frame_id": "laser"} | (
                    {"seq": number} if one else {}
                )
                message = types[TYPE](
                    header=types["std_msgs/msg/Header"](**header),
                    angle_min=-1.0,
                    angle_max=1.0,
                    angle_increment=0.5,
                    time_increment=0.0,
                    scan_time=0.1,
                    range_min=0.25,
                    range_max=12.0,
                    ranges=np.array(ranges, np.float32),
                    intensities=np.zeros(0, np.float32),
                )
                writer.write(connection, number, serialize(message, TYPE))
    return path


ROWS = [[1.0, 2.0, np.inf, 4.0], [0.1, np.nan, 3.0]]


@pytest.mark.parametrize(
    ("name", "storage"), [("a.bag", ""), ("folder", "sqlite3"), ("folder", "mcap")]
)
def test_every_kind_of_bag(tmp_path, name, storage):
    path = write_bag(tmp_path / name, {"/scan": ROWS}, storage)
    paths = [path, *path.glob("*.mcap"), *path.glob("*.db3")]
    assert len(paths) == (1 if name == "a.bag" else 2)
    for path in paths:
        log = read_scans(path)
        np.testing.assert_array_equal(log.ranges[0], ROWS[0])
        np.testing.assert_allclose(log.ranges[1], [*ROWS[1], np.nan], atol=1e-6)
        np.testing.assert_allclose(log.bearings, [[-1.0, -0.5, 0.0, 0.5]] * 2)
        assert (log.range_min, log.range_max) == (0.25, 12.0)
        np.testing.assert_array_equal(log.stamps, [100.5, 101.5])
        scan = log.scan(1)
        np.testing.assert_array_equal(scan.valid, [False, False, True, False])


def test_topics_are_asked_for(tmp_path):
    path = write_bag(tmp_path / "a.bag", {"/front": ROWS, "/rear": ROWS[:1]})
    with pytest.raises(ValueError, match=r"choose one of \['/front', '/rear'\]"):
        read_scans(path)
    with pytest.raises(ValueError, match="no scans on /scan, only on"):
        read_scans(path, topic="/scan")
    assert len(read_scans(path, topic="/rear")) == 1


def test_bags_without_scans(tmp_path):
    path = write_bag(tmp_path / "none.bag", {})
    with pytest.raises(ValueError, match="holds no sensor_msgs/msg/LaserScan"):
        read_scans(path)
    with pytest.raises(ValueError, match="holds none"):
        read_scans(write_bag(tmp_path / "silent.bag", {"/scan": []}))
    with pytest.raises(ValueError, match="are empty"):
        read_scans(write_bag(tmp_path / "empty.bag", {"/scan": [[]]}))


def test_torn_bags(tmp_path):
    for name, storage in (("a.bag", ""), ("sql", "sqlite3"), ("cap", "mcap")):
        path = write_bag(tmp_path / name, {"/scan": ROWS}, storage)
        content = next(path.glob("*.[dm]*[3p]")) if path.is_dir() else path
        content.write_bytes(content.read_bytes()[:150])
        for torn in {path, content}:
            with pytest.raises(ValueError, match="no readable rosbag"):
                read_scans(torn)
    (tmp_path / "nothing").mkdir()
    with pytest.raises(ValueError, match="no readable rosbag"):
        read_scans(tmp_path / "nothing")


def test_without_rosbags_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
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
    assert log.scan(0).echo.sum() > 360
