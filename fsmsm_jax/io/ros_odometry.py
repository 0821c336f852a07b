"""Where the lidar of a rosbag is by odometry, from what all its other topics say.

Odometry is an `Odometry` topic, or the transform in `/tf` from a frame `odom…` to
something that the lidar is fixed to. It speaks of the robot; `/tf_static` says where
the lidar sits on it (so do transforms in `/tf` that never change, the habit of ROS 1).
Where nothing does, the lidar is taken to sit at the base, and the remarks say so.
"""

from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fsmsm_jax.io.frames import Mounts, compose, interpolate, matrix, yaw

__all__ = ["Message", "find_odometry", "frame", "seconds"]


class Message(NamedTuple):
    """A decoded message and when it was recorded [s]."""

    recorded: float
    content: Any


class _Track(NamedTuple):
    """Where some frame was at which times: (n,) [s], (n, 3) [m], (n, 4) quaternions."""

    child: str
    times: np.ndarray
    translations: np.ndarray
    rotations: np.ndarray


def find_odometry(
    odometry: list[Message],
    transforms: dict[str, list[Message]],
    stamps: Float[np.ndarray, "scans"],
    lidar: str,
) -> tuple[Float[np.ndarray, "scans 3"] | None, bool, tuple[str, ...]]:
    """Poses of the lidar in the odometry's frame when it took its scans.

    Args:
        odometry: `Odometry` messages of one topic, none if there is no such topic.
        transforms: `TFMessage` messages by topic, those of `…tf_static` being fixed.
        stamps: of the scans [s].
        lidar: the frame of the scans.

    Returns:
        Poses [m, m, rad], NaN where odometry is missing, None if there is none at all;
        whether the lidar is upside down; remarks.

    Raises:
        ValueError: the lidar is tilted, so that its scans are not horizontal.
    """
    mounts, tracks = _transforms(transforms)
    track = _told(odometry) or _tracked(tracks, mounts, lidar)
    base = track.child if track is not None and track.child else mounts.root(lidar)
    mounting = mounts.find(base, lidar)
    remarks = []
    if mounting is None:
        mounting = np.zeros(3), False
        remarks.append(
            f"no static transform leads from {base} to {lidar}: the lidar is taken to "
            f"sit at {base}, looking ahead"
        )
    pose_base_lidar, mirrored = mounting
    if mirrored:
        remarks.append("the lidar is mounted upside down, its bearings were negated")
    if track is None:
        return None, mirrored, tuple(remarks)
    poses = np.column_stack([track.translations[:, :2], yaw(track.rotations)])
    if bad := np.sum(~np.isfinite(poses).all(axis=1)):
        remarks.append(
            f"{bad} of {len(poses)} odometry messages hold no pose and were left out"
        )
    found = compose(interpolate(stamps, track.times, poses), pose_base_lidar)
    return found, mirrored, tuple(remarks)


def _told(odometry: list[Message]) -> _Track | None:
    """The track of the base in `Odometry` messages."""
    if not odometry:
        return None
    poses = [message.content.pose.pose for message in odometry]
    return _Track(
        frame(odometry[0].content.child_frame_id),
        np.array([seconds(one.content.header.stamp, one) for one in odometry]),
        np.array([_vector(pose.position, "xyz") for pose in poses]),
        np.array([_vector(pose.orientation, "xyzw") for pose in poses]),
    )


def _tracked(
    tracks: dict[tuple[str, str], _Track], mounts: Mounts, lidar: str
) -> _Track | None:
    """The track in `/tf` of a base that the lidar is fixed to, the densest of many."""
    found = [
        track
        for (parent, child), track in tracks.items()
        if parent.split("/")[-1].startswith("odom")
        and mounts.find(child, lidar) is not None
    ]
    return max(found, key=lambda track: len(track.times), default=None)


def _transforms(
    messages: dict[str, list[Message]],
) -> tuple[Mounts, dict[tuple[str, str], _Track]]:
    """What is fixed to what, and the tracks of (parent, child) that move."""
    mounts = Mounts()
    moving = defaultdict(list)
    for topic, told in messages.items():
        for message in told:
            for each in message.content.transforms:
                parent, child = (
                    frame(each.header.frame_id),
                    frame(each.child_frame_id),
                )
                translation = _vector(each.transform.translation, "xyz")
                rotation = _vector(each.transform.rotation, "xyzw")
                if topic.endswith("tf_static"):
                    mounts.add(parent, child, matrix(translation, rotation))
                else:
                    time = seconds(each.header.stamp, message)
                    moving[parent, child].append((time, translation, rotation))
    tracks = {}
    for (parent, child), track in moving.items():
        times, translations, rotations = map(np.array, zip(*track, strict=True))
        tracks[parent, child] = _Track(child, times, translations, rotations)
        still = max(np.ptp(translations, axis=0).max(), np.ptp(rotations, axis=0).max())
        if still < 1e-6 and child not in mounts:
            mounts.add(parent, child, matrix(translations[0], rotations[0]))
    return mounts, tracks


def seconds(stamp: Any, message: Message) -> float:
    """The time of a message [s]; when it was recorded, if it bears none."""
    return (stamp.sec + 1e-9 * stamp.nanosec) or message.recorded


def frame(name: str) -> str:
    """Frames of old bags are spelt with a slash in front or without, both the same."""
    return name.lstrip("/")


def _vector(value: Any, names: str) -> np.ndarray:
    return np.array([getattr(value, name) for name in names], float)
