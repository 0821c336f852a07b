"""A planar covariance as ROS wants it: of six numbers, row-major, and back."""

import numpy as np
from jaxtyping import Array, Shaped

__all__ = ["from_ros", "to_ros"]

_PLANE = np.array([0, 1, 5])  # x, y and yaw among ROS's x, y, z, roll, pitch, yaw


def to_ros(covariance: Shaped[np.ndarray, "3 3"] | Array) -> list[float]:
    """The 36 numbers of a ROS `PoseWithCovariance`, row-major.

    Its rows are x, y, z, roll, pitch, yaw. A planar pose is silent about z, roll and
    pitch; their entries are 0, as AMCL publishes them. Whoever fuses the pose in three
    dimensions must leave those three out (`robot_localization`: `two_d_mode`, or false
    in `pose0_config`), as 0 would read as certainty.

    Example:
        >>> sent = to_ros(np.diag([0.04, 0.01, 0.001]))
        >>> len(sent), sent[0], sent[7], sent[35]
        (36, 0.04, 0.01, 0.001)
    """
    full = np.zeros((6, 6))
    full[np.ix_(_PLANE, _PLANE)] = np.asarray(covariance, float)
    return full.ravel().tolist()


def from_ros(covariance: Shaped[np.ndarray, "..."] | list[float]) -> np.ndarray:
    """The planar part (3, 3), [m, m, rad]², of a ROS covariance of 36 numbers.

    Raises:
        ValueError: there are not 36 numbers, flat or as 6 × 6.
    """
    given = np.asarray(covariance, float)
    if given.shape not in ((36,), (6, 6)):
        raise ValueError(
            f"a ROS pose covariance has 36 numbers, row-major, got shape {given.shape}"
        )
    return given.reshape(6, 6)[np.ix_(_PLANE, _PLANE)]
