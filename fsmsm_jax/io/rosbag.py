"""Rosbags: scans and odometry out of ROS 1 and ROS 2 recordings, without ROS.

The `rosbags` package reads all of them in pure Python: a ROS 1 `.bag`, a ROS 2 folder
with its `metadata.yaml`, or a lone `.db3` or `.mcap` of one. It is an optional
dependency and is imported only when a bag is opened. A bag that breaks off has lost its
index; `io.salvage` reads what is there.

A `LaserScan` says where its rays point and when they were taken, the stamp being the
first ray's (some drivers get the order wrong: `ScanLog.reversed_sweep`). Some drivers
return a few rays more or less from turn to turn: rows are padded with NaN, so that all
scans of a log have one shape and compile once. By REP 117, +inf is "no echo", −inf
"too close" and NaN "broken"; `Scan` reads them so.

Odometry and the mounting of the lidar come from other topics, see `io.ros_odometry`. A
lidar that is mounted upside down sees the world mirrored; its bearings are negated, so
that its scans and poses are those of an upright lidar at the same place.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fsmsm_jax.io.layout import stack_rows
from fsmsm_jax.io.logs import ScanLog
from fsmsm_jax.io.ros_odometry import Message, find_odometry, frame, seconds
from fsmsm_jax.io.salvage import RawMessage, salvage

__all__ = ["read_rosbag"]

_SCAN = "sensor_msgs/msg/LaserScan"
_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_TRANSFORMS_OF_ROS1 = "geometry_msgs/TransformStamped[] transforms"
_OLD_TRANSFORMS = "tf/msg/tfMessage"
_RANGE_MAX = 30.0  # [m] where no message states a limit, as in `Scan.from_ranges`


class _WrongTopic(ValueError):
    """The bag is in order, but has not what was asked for."""


class _Topics(NamedTuple):
    """Which topics of a bag are read."""

    scan: str
    odometry: str | None
    transforms: tuple[str, ...]
    remarks: tuple[str, ...]


def read_rosbag(
    path: Path, topic: str | None = None, odometry_topic: str | None = None
) -> ScanLog:
    """All `LaserScan` messages of one topic, with the odometry at their stamps.

    The range limits are the tightest that any message states. Odometry is missing
    before its first and after its last message and in gaps longer than 0.5 s.

    Args:
        path: `.bag`, `.db3`, `.mcap` or the folder of a ROS 2 bag.
        topic: needed only where the bag has several scan topics.
        odometry_topic: an `Odometry` topic; without it, the one whose name ends in
            `odom`, else the first by name.

    Raises:
        ValueError: no scan can be read; the bag holds none on `topic`, or no odometry
            on `odometry_topic`; it has several scan topics and `topic` is None; the
            lidar is mounted so that its scans are not horizontal.
        ImportError: the `rosbags` package is not installed.
    """
    topics, messages, remarks = _messages(path, topic, odometry_topic)
    scans = messages[topics.scan]
    if not scans:
        raise ValueError(f"{path.name} announces scans but holds none; was it cut off?")
    contents = [scan.content for scan in scans]
    if not any(len(scan.ranges) for scan in contents):
        raise ValueError(f"all {len(scans)} scans of {path.name} are empty")
    ranges, bearings, mended = stack_rows(
        [scan.ranges for scan in contents],
        np.array([scan.angle_min for scan in contents], float),
        np.array([scan.angle_increment for scan in contents], float),
    )
    stamps = np.array([seconds(scan.content.header.stamp, scan) for scan in scans])
    odometry, mirrored, told = find_odometry(
        messages[topics.odometry or ""],
        {name: messages[name] for name in topics.transforms},
        stamps,
        frame(scans[0].content.header.frame_id),
    )
    delay = np.nan_to_num(
        [scan.time_increment for scan in contents], posinf=0, neginf=0
    )
    range_min, range_max, limits = _limits(contents)
    return ScanLog(
        ranges=ranges,
        bearings=-bearings if mirrored else bearings,
        range_min=range_min,
        range_max=range_max,
        stamps=stamps,
        odometry=odometry,
        ray_times=delay[:, None] * np.arange(ranges.shape[1]) if delay.any() else None,
        remarks=(*remarks, *topics.remarks, *mended, *limits, *told),
    )


def _messages(
    path: Path, topic: str | None, odometry_topic: str | None
) -> tuple[_Topics, dict[str, list[Message]], list[str]]:
    """The topics that are meant, their messages in order, and remarks."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ImportError(
            "reading rosbags needs the rosbags package: pip install 'fsmsm-jax[ros]'"
        ) from error
    # Bags may carry definitions of their messages or not; the ones here never changed.
    if path.suffix == ".bag":
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg(_TRANSFORMS_OF_ROS1, _TRANSFORMS))
        decode = store.deserialize_ros1
    else:
        store = get_typestore(Stores.LATEST)
        decode = store.deserialize_cdr
    remarks = []
    choose = lambda kinds: _choose(path, kinds, topic, odometry_topic)
    try:
        topics, raws = _indexed(path, choose, store)
    except _WrongTopic:
        raise
    except Exception as error:  # a torn bag fails anywhere in the reader, in any way
        raws = salvage(path, (_SCAN, _ODOMETRY, _TRANSFORMS, _OLD_TRANSFORMS))
        kinds = {raw.topic: raw.kind for raw in raws}
        if _SCAN not in kinds.values():
            raise ValueError(f"{path.name} is no readable rosbag: {error}") from error
        topics = choose(kinds)
        count = sum(raw.topic == topics.scan for raw in raws)
        remarks.append(f"the bag is damaged ({error}): {count} scans could be read")
    messages, garbage = defaultdict(list), 0
    for raw in raws:
        kind = _TRANSFORMS if raw.kind == _OLD_TRANSFORMS else raw.kind
        try:
            messages[raw.topic].append(Message(raw.recorded, decode(raw.data, kind)))
        except Exception:  # random bytes fail anywhere in the decoder
            garbage += 1
    if garbage:
        remarks.append(
            f"{garbage} of {len(raws)} messages are garbage and were left out"
        )
    return topics, messages, remarks


def _indexed(
    path: Path, choose: Callable[[dict[str, str]], _Topics], store: Any
) -> tuple[_Topics, list[RawMessage]]:
    """What `choose` chooses of the topics of a bag in order, and their messages."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path], default_typestore=store) as reader:
        topics = choose({c.topic: c.msgtype for c in reader.connections})
        wanted = {topics.scan, topics.odometry, *topics.transforms}
        connections = [c for c in reader.connections if c.topic in wanted]
        return topics, [
            RawMessage(c.topic, c.msgtype, 1e-9 * at, data)
            for c, at, data in reader.messages(connections=connections)
        ]


def _choose(
    path: Path, kinds: dict[str, str], topic: str | None, odometry_topic: str | None
) -> _Topics:
    of = lambda *wanted: sorted(name for name in kinds if kinds[name] in wanted)
    scans, odometries, remarks = of(_SCAN), of(_ODOMETRY), ()
    if not scans:
        raise _WrongTopic(f"{path.name} holds no {_SCAN} messages")
    if topic is None and len(scans) > 1:
        raise _WrongTopic(f"{path.name} has several scan topics, choose one of {scans}")
    if topic is not None and topic not in scans:
        raise _WrongTopic(f"{path.name} has no scans on {topic}, only on {scans}")
    if odometry_topic is not None and odometry_topic not in odometries:
        raise _WrongTopic(
            f"{path.name} has no odometry on {odometry_topic}, only on {odometries}"
        )
    if odometry_topic is None and odometries:
        odometry_topic = min(odometries, key=lambda name: not name.endswith("odom"))
        if len(odometries) > 1:
            remarks = (
                f"of the odometry topics {odometries}, {odometry_topic} is used",
            )
    transforms = tuple(of(_TRANSFORMS, _OLD_TRANSFORMS))
    return _Topics(topic or scans[0], odometry_topic, transforms, remarks)


def _limits(scans: list[Any]) -> tuple[float, float, tuple[str, ...]]:
    """The tightest range limits [m], and whether they are the same in all messages."""
    least = np.array([scan.range_min for scan in scans], float)
    most = np.array([scan.range_max for scan in scans], float)
    least = np.unique(least[np.isfinite(least) & (least >= 0)])
    most = np.unique(most[np.isfinite(most) & (most > 0)])
    range_min, range_max = (
        float(least.max(initial=0.0)),
        float(most.min(initial=np.inf)),
    )
    remarks = ()
    if not len(most):
        range_max = _RANGE_MAX
        remarks = (f"no scan states its largest range, {range_max} m is taken",)
    elif len(most) > 1 or len(least) > 1:
        remarks = (
            f"the range limits change, {range_min:g} to {range_max:g} m are taken",
        )
    return range_min, range_max, remarks
