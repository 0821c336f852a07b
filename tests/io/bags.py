"""Rosbags made for tests: scans, odometry and transforms, in all formats."""

import numpy as np
import pytest

SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FORMATS = [("a.bag", ""), ("folder", "sqlite3"), ("folder", "mcap")]


def scan(stamp, ranges, frame="laser", **fields):
    return SCAN, stamp, {"ranges": ranges, "frame": frame} | fields


def odometry(stamp, pose, frame="base_link"):
    return ODOMETRY, stamp, {"pose": pose, "frame": frame}


def transforms(stamp, *parent_child_translation_rotation):
    return TRANSFORMS, stamp, {"transforms": parent_child_translation_rotation}


def about_z(angle):
    return (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))


def write_bag(path, messages, storage="sqlite3"):
    """Write (topic, (kind, stamp, content)) as a bag of the kind that the path says."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    if one:
        form = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(form, TRANSFORMS))
        writer, serialize = rosbag1.Writer(path), store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin[storage.upper()]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        serialize = store.serialize_cdr
    with writer:
        connections = {}
        for number, (topic, (kind, stamp, content)) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            if content is not None:
                message = _BUILDERS[kind](
                    _Maker(store.types, one, number), stamp, content
                )
                writer.write(connections[topic], number, serialize(message, kind))
    return path


class _Maker:
    def __init__(self, types, one, number):
        self.types, self.one, self.number = types, one, number

    def __call__(self, name, *values, **fields):
        return self.types[name](*values, **fields)

    def header(self, stamp, frame):
        seq = {"seq": self.number} if self.one else {}
        whole = int(stamp)
        time = self(
            "builtin_interfaces/msg/Time",
            sec=whole,
            nanosec=round((stamp - whole) * 1e9),
        )
        return self("std_msgs/msg/Header", **seq, stamp=time, frame_id=frame)


def _scan(make, stamp, content):
    fields = {
        "angle_min": -1.0,
        "angle_max": 1.0,
        "angle_increment": 0.5,
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.25,
        "range_max": 12.0,
    } | {k: v for k, v in content.items() if k not in ("ranges", "frame")}
    return make(
        SCAN,
        header=make.header(stamp, content["frame"]),
        ranges=np.array(content["ranges"], np.float32),
        intensities=np.zeros(0, np.float32),
        **fields,
    )


def _odometry(make, stamp, content):
    x, y, theta = content["pose"]
    vector = lambda *v: make("geometry_msgs/msg/Vector3", *v)
    pose = make(
        "geometry_msgs/msg/Pose",
        make("geometry_msgs/msg/Point", x, y, 0.0),
        make("geometry_msgs/msg/Quaternion", *about_z(theta)),
    )
    twist = make(
        "geometry_msgs/msg/Twist", vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)
    )
    return make(
        ODOMETRY,
        header=make.header(stamp, "odom"),
        child_frame_id=content["frame"],
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
    )


def _transforms(make, stamp, content):
    return make(
        TRANSFORMS,
        transforms=[
            make(
                "geometry_msgs/msg/TransformStamped",
                header=make.header(stamp, parent),
                child_frame_id=child,
                transform=make(
                    "geometry_msgs/msg/Transform",
                    make("geometry_msgs/msg/Vector3", *translation),
                    make("geometry_msgs/msg/Quaternion", *rotation),
                ),
            )
            for parent, child, translation, rotation in content["transforms"]
        ],
    )


_BUILDERS = {SCAN: _scan, ODOMETRY: _odometry, TRANSFORMS: _transforms}
