"""Rosbags: `sensor_msgs/LaserScan` out of ROS 1 and ROS 2 recordings, without ROS.

The `rosbags` package reads all of them in pure Python: a ROS 1 `.bag`, a ROS 2 folder
with its `metadata.yaml`, or a lone `.db3` or `.mcap` of one. It is an optional
dependency and is imported only when a bag is opened.

A `LaserScan` says all about its rays but where the lidar sits on the robot; that is in
`/tf_static` and is left there, as the pose of the *lidar* is what a scan can tell. Some
drivers return a few rays more or less from turn to turn: rows are padded with NaN, so
that all scans of a log have one shape and compile once. By REP 117, +inf is "no echo",
−inf "too close" and NaN "broken"; `Scan` reads them so.
"""

from pathlib import Path

import numpy as np

from fsmsm_jax.io.logs import ScanLog

__all__ = ["read_rosbag"]

_SCAN_TYPE = "sensor_msgs/msg/LaserScan"


def read_rosbag(path: Path, topic: str | None = None) -> ScanLog:
    """All `LaserScan` messages of one topic.

    The range limits are the tightest that any message states.

    Args:
        path: `.bag`, `.db3`, `.mcap` or the folder of a ROS 2 bag.
        topic: needed only where the bag has several scan topics.

    Raises:
        ValueError: the bag is torn or no bag; it holds no scans, or none on `topic`;
            it has several scan topics and `topic` is None.
        ImportError: the `rosbags` package is not installed.
    """
    messages = _scan_messages(path, topic)
    if not messages:
        raise ValueError(f"{path.name} announces scans but holds none; was it cut off?")
    rays = max(len(message.ranges) for message in messages)
    if rays == 0:
        raise ValueError(f"all {len(messages)} scans of {path.name} are empty")
    ranges = np.full((len(messages), rays), np.nan)
    bearings = np.empty((len(messages), rays))
    for row, message in enumerate(messages):
        ranges[row, : len(message.ranges)] = message.ranges
        bearings[row] = message.angle_min + message.angle_increment * np.arange(rays)
    stamps = [message.header.stamp for message in messages]
    return ScanLog(
        ranges=ranges,
        bearings=bearings,
        range_min=max(float(message.range_min) for message in messages),
        range_max=min(float(message.range_max) for message in messages),
        stamps=np.array([stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]),
    )


def _scan_messages(path: Path, topic: str | None) -> list:
    """The messages of the one scan topic that is meant, in recording order."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(
            "reading rosbags needs the rosbags package: pip install 'fsmsm-jax[ros]'"
        ) from error
    try:
        # Old ROS 2 bags carry no message definitions; LaserScan never changed.
        typestore = get_typestore(Stores.LATEST)
        with AnyReader([path], default_typestore=typestore) as reader:
            connections = [c for c in reader.connections if c.msgtype == _SCAN_TYPE]
            chosen = _choose(path, sorted({c.topic for c in connections}), topic)
            wanted = [c for c in connections if c.topic == chosen]
            return [
                reader.deserialize(raw, connection.msgtype)
                for connection, _, raw in reader.messages(connections=wanted)
            ]
    except ValueError:
        raise
    except Exception as error:  # a torn bag fails anywhere in the reader, in any way
        raise ValueError(f"{path.name} is no readable rosbag: {error}") from error


def _choose(path: Path, topics: list[str], topic: str | None) -> str:
    if not topics:
        raise ValueError(f"{path.name} holds no {_SCAN_TYPE} messages")
    if topic is None and len(topics) > 1:
        raise ValueError(f"{path.name} has several scan topics, choose one of {topics}")
    if topic is not None and topic not in topics:
        raise ValueError(f"{path.name} has no scans on {topic}, only on {topics}")
    return topic or topics[0]
