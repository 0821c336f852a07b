r"""How far does odometry stray: errors per metre of the way, as KITTI counts them.

Odometry has no place to be right about, only motions. An error of the heading at the
start bends all that follows, so the distance to the truth at the end says more of when
something went wrong than of how much. Relative errors do not: take two moments i and j
that lie a length ℓ of the way apart, and compare the motion between them,

    E = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j),

reference R against poses P. |E|'s translation and angle, divided by ℓ, are the drift of
this sub-path; the mean over all starts and some lengths is the drift of the odometry.
Where P begins, and in what frame, does not matter. The lengths do: over the short ones
the errors of the reference count (2 cm in each pose are 3 % of a metre), over the long
ones headings weigh more. So the lengths are stated with every number.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

__all__ = ["LENGTHS", "Drift", "drift", "way"]

LENGTHS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Lengths of the sub-paths [m]: KITTI's 100 to 800 m, for robots in buildings."""

_LEG = 0.1  # [m]: shorter legs of the reference are its noise, not its way
_OVERSHOOT = 0.5  # of a length: a gap in the reference may end a sub-path this late


class Drift(NamedTuple):
    """Errors of all sub-paths, each as one entry; and what they come to."""

    translation: Float[np.ndarray, "paths"]
    """Distance by which the motion over a sub-path is wrong, per metre [m/m]."""
    rotation: Float[np.ndarray, "paths"]
    """Angle by which it is wrong, per metre [rad/m]."""
    wanted: Float[np.ndarray, "paths"]
    """Of the lengths that were asked for, the one that the sub-path stands for [m]."""
    length: Float[np.ndarray, "paths"]
    """Its length along the reference [m]."""
    start: Int[np.ndarray, "paths"]
    """Index of the pose at which it begins."""
    end: Int[np.ndarray, "paths"]
    """Index of the pose at which it ends."""

    def mean(self, wanted: float | None = None) -> tuple[float, float]:
        """Mean drift [m/m, rad/m] over one length, or over all: each counts alike.

        NaN where no sub-path is as long.
        """
        if wanted is None:
            each = [self.mean(length) for length in np.unique(self.wanted)]
            return tuple(np.mean(each, axis=0).tolist()) if each else (np.nan, np.nan)
        mine = self.wanted == wanted
        if not mine.any():
            return np.nan, np.nan
        return float(self.translation[mine].mean()), float(self.rotation[mine].mean())

    def worst(self) -> tuple[float, float]:
        """Largest drifts [m/m, rad/m] of any sub-path, each by itself; NaN if none."""
        if not len(self.length):
            return np.nan, np.nan
        return float(self.translation.max()), float(self.rotation.max())


def drift(
    poses: Shaped[np.ndarray, "scans 3"],
    reference: Shaped[np.ndarray, "references 3"],
    lengths: Sequence[float] = LENGTHS,
) -> Drift:
    """Relative errors of a trajectory per metre, over sub-paths of some lengths.

    Args:
        poses: what is judged [m, m, rad], in any frame; rows of NaN are not known.
        reference: poses of the same thing (the lidar, not the base) at the same
            moments, in a frame of their own; rows of NaN where there are none. Sparse
            ones will do.
        lengths: of the sub-paths [m]. Each known reference pose begins one of each
            length; it ends at the first known pose at least so far along the way, and
            is left out if that is half as far again.

    Raises:
        ValueError: not as many poses as references; a length that is not positive.

    Example:
        >>> x = np.arange(0.0, 30.0, 0.5)
        >>> straight = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
        >>> wheels = straight * 1.02  # of a radius that is 2 % too large
        >>> [round(d, 4) for d in drift(wheels, straight).mean()]
        [0.02, 0.0]

    Reference:
        A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving? The KITTI
        vision benchmark suite", CVPR 2012, with lengths of a tenth and less. We divide
        by the length that a sub-path has, not by the one that it stands for.
    """
    poses, reference = np.asarray(poses, float), np.asarray(reference, float)
    if poses.shape != reference.shape or poses.ndim != 2 or poses.shape[1] != 3:
        raise ValueError(
            "expected as many poses [x, y, θ] as references, got shapes "
            f"{poses.shape} and {reference.shape}"
        )
    if not (len(lengths) and all(0 < length < np.inf for length in lengths)):
        raise ValueError(f"lengths of sub-paths are positive [m], got {lengths}")
    known = np.flatnonzero(np.isfinite(poses).all(1) & np.isfinite(reference).all(1))
    along = way(reference[known])

    parts = []
    for wanted in lengths:
        ends = np.searchsorted(along, along + wanted - 1e-9)
        starts = np.flatnonzero(ends < len(known))
        ends = ends[starts]
        length = along[ends] - along[starts]
        fits = length <= (1 + _OVERSHOOT) * wanted
        starts, ends, length = starts[fits], ends[fits], length[fits]
        i, j = known[starts], known[ends]
        off = _between(
            _between(reference[i], reference[j]), _between(poses[i], poses[j])
        )
        metres, radians = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
        stands_for = np.full(len(i), wanted)
        parts.append((metres / length, radians / length, stands_for, length, i, j))
    return Drift(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def way(poses: Shaped[np.ndarray, "poses 3"]) -> Float[np.ndarray, "poses"]:
    """How far along its way each pose is [m], the noise of standing still left out.

    The way goes in legs of at least 0.1 m: from a pose to the first that is as far
    away, and so on. Poses in between are as far along as the leg's beginning.

    Args:
        poses: [m, m, rad], all finite.
    """
    along = np.zeros(len(poses))
    anchor = poses[:1, :2].reshape(-1)
    for n in range(1, len(poses)):
        leg = float(np.hypot(*(poses[n, :2] - anchor)))
        along[n] = along[n - 1]
        if leg >= _LEG:
            along[n], anchor = along[n] + leg, poses[n, :2]
    return along


def _between(a, b):
    """Poses b in the frames of poses a, in float64: ways are long, errors small."""
    dx, dy, turn = (b - a).T
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    wrapped = np.mod(turn + np.pi, 2 * np.pi) - np.pi
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrapped], axis=1)
