"""Where the lidar is by odometry, when odometry speaks of the base and at other times.

Three small jobs that any log with odometry needs: the base's poses become the lidar's
(`compose` with how the lidar is mounted), poses at the odometry's times become poses at
the scans' times (`interpolate`), and a chain of mounted parts becomes one planar pose
(`Mounts`). All of it happens once, on the host, in NumPy's double precision: odometry
may be kilometres from its origin while what counts are millimetres between two scans.
"""

import numpy as np
from jaxtyping import Float

__all__ = ["Mounts", "between", "chain", "compose", "interpolate", "matrix", "yaw"]

_LONGEST_GAP = 0.5  # [s] between two odometry messages that may be bridged
_LARGEST_TILT = np.deg2rad(15.0)


def _wrap(angle: np.ndarray | np.floating) -> np.ndarray | np.floating:
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def compose(
    poses_a_b: Float[np.ndarray, "*n 3"], poses_b_c: Float[np.ndarray, "*m 3"]
) -> Float[np.ndarray, "... 3"]:
    """Poses of c in a [m, m, rad]; either side may be one pose for all of the other.

    Example:
        >>> turned = np.array([[1.0, 2.0, np.pi / 2]])
        >>> compose(turned, np.array([1.0, 0.0, 0.0])).round(3)
        array([[1.   , 3.   , 1.571]])
    """
    x, y, theta = np.moveaxis(poses_a_b, -1, 0)
    dx, dy, turn = np.moveaxis(poses_b_c, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([x + c * dx - s * dy, y + s * dx + c * dy, _wrap(theta + turn)], -1)


def between(
    poses_a_b: Float[np.ndarray, "*n 3"], poses_a_c: Float[np.ndarray, "*m 3"]
) -> Float[np.ndarray, "... 3"]:
    """Poses of c in b, from poses of both in a."""
    x, y, theta = np.moveaxis(poses_a_b, -1, 0)
    c, s = np.cos(theta), np.sin(theta)
    inverse = np.stack([-(c * x + s * y), s * x - c * y, -theta], -1)
    return compose(inverse, poses_a_c)


def chain(
    start: Float[np.ndarray, "3"], motions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n+1 3"]:
    """The poses that motions lead to, each in the frame of the pose before it."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(motions[:, 2])])
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    dx, dy = motions[:, 0], motions[:, 1]
    steps = np.stack([c * dx - s * dy, s * dx + c * dy], -1)
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, _wrap(theta)])


def interpolate(
    stamps: Float[np.ndarray, "scans"],
    times: Float[np.ndarray, "messages"],
    poses: Float[np.ndarray, "messages 3"],
    longest_gap: float = _LONGEST_GAP,
) -> Float[np.ndarray, "scans 3"]:
    """Poses at `stamps`: linear in x and y, the shorter way round in the heading.

    Args:
        stamps: when poses are wanted [s], in any order.
        times: when they are known [s], in any order; what is not finite is left out.
        poses: what they are then [m, m, rad].
        longest_gap: between messages farther apart than this [s] nothing is known.

    Returns:
        Poses [m, m, rad], NaN where a stamp lies outside the times or in a gap.

    Example:
        >>> poses = np.array([[0.0, 0.0, 3.0], [1.0, 0.0, -3.0]])
        >>> interpolate(np.array([0.3, 9.0]), np.array([0.0, 0.4]), poses).round(3)
        array([[ 0.75 ,  0.   , -3.071],
               [  nan,    nan,    nan]])
    """
    known = np.isfinite(times) & np.isfinite(poses).all(axis=1)
    times, first = np.unique(times[known], return_index=True)
    poses = poses[known][first]
    if not len(times):
        return np.full((len(stamps), 3), np.nan)
    after = np.searchsorted(times, stamps).clip(0, len(times) - 1)
    before = np.where(times[after] > stamps, after - 1, after).clip(0)
    gap = times[after] - times[before]
    share = (stamps - times[before]) / np.where(gap > 0, gap, 1.0)
    step = poses[after] - poses[before]
    step[:, 2] = _wrap(step[:, 2])
    found = poses[before] + share[:, None] * step
    found[:, 2] = _wrap(found[:, 2])
    bridged = (
        (times[before] <= stamps) & (stamps <= times[after]) & (gap <= longest_gap)
    )
    return np.where(bridged[:, None], found, np.nan)


def yaw(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Headings [rad] of orientations (x, y, z, w); NaN where they are no rotation.

    A quaternion of any length but 0 means the rotation of its direction.
    """
    x, y, z, w = quaternions.T
    length = x * x + y * y + z * z + w * w
    heading = np.arctan2(2 * (w * z + x * y), length - 2 * (y * y + z * z))
    return np.where(length > 1e-6, heading, np.nan)


def matrix(
    translation: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "4 4"]:
    """The transform of points [m] by a rotation (x, y, z, w), then a translation.

    NaN if the quaternion is 0 and thus no rotation.
    """
    length = np.linalg.norm(quaternion)
    x, y, z, w = quaternion / (length if length > 1e-6 else np.nan)
    T = np.eye(4)
    T[:3, 3] = translation
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return T


class Mounts:
    """Which part is fixed to which, and how: the tree that `/tf_static` spells out."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, np.ndarray]] = {}

    def add(self, parent: str, child: str, T_parent_child: np.ndarray) -> None:
        """Fix `child` to `parent`; a later word on the same child replaces this one."""
        if np.isfinite(T_parent_child).all():
            self._parents[child] = (parent, T_parent_child)

    def __contains__(self, child: str) -> bool:
        return child in self._parents

    def _ancestors(self, frame: str) -> dict[str, np.ndarray]:
        """The transform of `frame` in each frame above it, itself first."""
        found = {frame: np.eye(4)}
        T = np.eye(4)
        while frame in self._parents:
            frame, T_parent_child = self._parents[frame]
            if frame in found:  # a circle
                break
            T = T_parent_child @ T
            found[frame] = T
        return found

    def root(self, frame: str) -> str:
        """What `frame` is fixed to in the end."""
        return list(self._ancestors(frame))[-1]

    def find(self, base: str, lidar: str) -> tuple[np.ndarray, bool] | None:
        """How the lidar sits on the base: its planar pose, and whether upside down.

        Upside down, a scan is the mirror image of what an upright lidar at that pose
        sees: negate its bearings and use the pose as it is.

        Returns:
            (3,) pose of the lidar in the base [m, m, rad] and whether its z axis
            points down; None if the two are not fixed to a common part.

        Raises:
            ValueError: the lidar is tilted by more than 15°, so that its scans are no
                horizontal slice.
        """
        above_base, above_lidar = self._ancestors(base), self._ancestors(lidar)
        common = next((frame for frame in above_lidar if frame in above_base), None)
        if common is None:
            return None
        T = np.linalg.inv(above_base[common]) @ above_lidar[common]
        if abs(T[2, 2]) < np.cos(_LARGEST_TILT):
            tilt = np.rad2deg(np.arccos(np.clip(T[2, 2], -1, 1)))
            raise ValueError(
                f"the lidar {lidar} is tilted by {tilt:.0f}° against {base}; a planar "
                "map needs scans of a horizontal plane"
            )
        return np.array([*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])]), bool(T[2, 2] < 0)
