r"""How good is a way and a map that were found without either: SLAM against the truth.

SLAM knows where it began and nothing else. If its first turn is wrong by half a degree,
everything after is turned with it, map and way alike; no later look can mend that, and
no user of the map would notice. So errors come twice: as they are, in the frame of the
truth, and *aligned*, after the rigid motion of the whole way that brings it closest to
the truth (least squares, no scale). The difference is the gauge.

Is a filter as sure as it may be? Squares of errors in units of the claimed covariance
(NEES) average the number of coordinates k if it is honest; the mean over n runs is χ²
with n k degrees of freedom, divided by n, so an interval can be told which it leaves in
one step of twenty.

Filters draw at random: compare two of them on the same seeds (`estimates.paired`).

Reference: T. Bailey, J. Nieto, E. Nebot, "Consistency of the FastSLAM algorithm", ICRA
2006; the rigid fit is that of S. Umeyama, T-PAMI 13(4), 1991, in the plane.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Shaped
from scipy import stats
from scipy.optimize import linear_sum_assignment

__all__ = [
    "Consistency",
    "MapError",
    "WayError",
    "chi2_bounds",
    "consistency",
    "map_error",
    "moved",
    "onto",
    "way_error",
]

Points = Shaped[np.ndarray, "*runs n 2"] | Shaped[Array, "*runs n 2"]


class WayError(NamedTuple):
    """How far a way is from where the vehicle was."""

    distance: Float[np.ndarray, "*runs fixes"]
    """At each fix [m]."""
    aligned: Float[np.ndarray, "*runs fixes"]
    """The same, after the best rigid motion of the whole way [m]."""
    gauge: Float[np.ndarray, "*runs 3"]
    """That motion [m, m, rad], for `moved`."""

    @property
    def rms(self) -> Float[np.ndarray, "*runs"]:
        """Root mean square of the distances [m]."""
        return _rms(self.distance)

    @property
    def aligned_rms(self) -> Float[np.ndarray, "*runs"]:
        """Of the distances that alignment leaves [m]."""
        return _rms(self.aligned)


class MapError(NamedTuple):
    """How far landmarks are from the surveyed ones that they stand for."""

    distance: Float[np.ndarray, "pairs"]
    """Of each pair [m]."""
    missing: int
    """Surveyed ones without a landmark."""
    extra: int
    """Landmarks of nothing that was surveyed, doubles among them."""

    @property
    def rms(self) -> float:
        """Root mean square of the pairs' distances [m]; NaN if there are none."""
        return float(_rms(self.distance)) if self.distance.size else float("nan")


class Consistency(NamedTuple):
    """Whether a filter is as sure as it may be, step by step."""

    average: Float[np.ndarray, "steps"]
    """NEES, averaged over the runs; NaN where a claimed covariance was singular."""
    low: float
    """Of 95 % of honest averages, the lower end."""
    high: float
    """And the upper."""

    @property
    def inside(self) -> float:
        """Share of the steps whose average is between the two: 0.95 if honest."""
        known = self.average[~np.isnan(self.average)]
        return float(np.mean((known >= self.low) & (known <= self.high)))

    @property
    def mean(self) -> float:
        """Over all steps; the number of coordinates if honest, more if too sure."""
        return float(np.nanmean(self.average))


def _rms(distance: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(distance**2, axis=-1)))


def way_error(
    times: Shaped[np.ndarray, "n"] | Shaped[Array, "n"],
    poses: Shaped[np.ndarray, "*runs steps 3"] | Shaped[Array, "*runs steps 3"],
    fixes: Shaped[np.ndarray, "fixes 3"] | Shaped[Array, "fixes 3"],
) -> WayError:
    """Compare estimated ways with fixes, by GPS or of the truth.

    Args:
        times: of the estimates [s], not decreasing.
        poses: estimates [m, m, rad], of one run or many. Between two of them the way is
            taken to be straight.
        fixes: time [s] and true place [m, m]. Those before the first estimate and after
            the last are left out.

    Raises:
        ValueError: not as many times as poses, or no fix lies between them.

    Example:
        >>> way = np.array([[0.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
        >>> error = way_error(np.array([0.0, 2.0]), way, np.array([[1.0, 1.0, 0.0]]))
        >>> float(error.rms), float(error.aligned_rms)
        (1.0, 0.0)
    """
    times, poses = np.asarray(times, float), np.asarray(poses, float)
    fixes = np.asarray(fixes, float)
    if len(times) != poses.shape[-2]:
        raise ValueError(
            f"expected a time for each pose, got {len(times)} times and "
            f"poses of shape {poses.shape}"
        )
    fixes = fixes[(fixes[:, 0] >= times[0]) & (fixes[:, 0] <= times[-1])]
    if not len(fixes):
        raise ValueError(f"no fix between {times[0]} and {times[-1]} s")
    after = np.clip(np.searchsorted(times, fixes[:, 0]), 1, max(1, len(times) - 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    lasting = times[after] - times[before]
    share = (fixes[:, 0] - times[before]) / np.where(lasting > 0, lasting, 1.0)
    share = np.where(lasting > 0, share, 1.0)[:, None]
    places = poses[..., :2]
    there = (1 - share) * places[..., before, :] + share * places[..., after, :]
    true = np.broadcast_to(fixes[:, 1:], there.shape)
    gauge = onto(there, true)
    apart = lambda points: np.linalg.norm(points - true, axis=-1)
    return WayError(apart(there), apart(moved(gauge, there)), gauge)


def onto(points: Points, reference: Points) -> Float[np.ndarray, "*runs 3"]:
    """The rigid motion that brings points closest to others, by least squares.

    Args:
        points: what is moved [m].
        reference: as many, in the same order [m].

    Returns:
        The pose [m, m, rad] of the points' frame in the other; for `moved`.

    Example:
        >>> corner = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
        >>> turned = np.array([[5.0, 1.0], [5.0, 3.0], [4.0, 1.0]])
        >>> [round(float(number), 3) for number in onto(corner, turned)]
        [5.0, 1.0, 1.571]
    """
    points, reference = np.asarray(points, float), np.asarray(reference, float)
    middle, target = points.mean(axis=-2), reference.mean(axis=-2)
    a, b = points - middle[..., None, :], reference - target[..., None, :]
    along = np.sum(a * b, axis=(-2, -1))
    across = np.sum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], axis=-1)
    turn = np.arctan2(across, along)
    turned = moved(_pose(0 * turn, 0 * turn, turn), middle[..., None, :])[..., 0, :]
    shift = target - turned
    return _pose(shift[..., 0], shift[..., 1], turn)


def moved(
    pose: Float[np.ndarray, "*runs 3"], points: Points
) -> Float[np.ndarray, "*runs n 2"]:
    """Points of a frame in the frame in which its pose is given [m]; in float64."""
    x, y, turn = (number[..., None] for number in np.moveaxis(pose, -1, 0))
    here = np.asarray(points, float)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack(
        [
            x + c * here[..., 0] - s * here[..., 1],
            y + s * here[..., 0] + c * here[..., 1],
        ],
        axis=-1,
    )


def _pose(x, y, turn):
    return np.stack([x, y, turn], axis=-1)


def map_error(
    places: Shaped[np.ndarray, "landmarks 2"] | Shaped[Array, "landmarks 2"],
    surveyed: Shaped[np.ndarray, "surveyed 2"] | Shaped[Array, "surveyed 2"],
    within: float = 2.0,
) -> MapError:
    """Pair landmarks with surveyed ones, each with at most one, at the least distance.

    Args:
        places: of the landmarks found [m]; `moved` first, to compare without gauge.
        surveyed: true places [m].
        within: the distance that a pair may be apart [m].

    Example:
        >>> found = np.array([[0.0, 0.1], [0.0, 0.4], [9.0, 9.0]])
        >>> map_error(found, np.array([[0.0, 0.0], [50.0, 0.0]]))
        MapError(distance=array([0.1]), missing=1, extra=2)
    """
    places, surveyed = np.asarray(places, float), np.asarray(surveyed, float)
    apart = np.linalg.norm(places[:, None] - surveyed[None], axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(apart, within))
    distance = apart[rows, columns]
    distance = distance[distance < within]
    pairs = len(distance)
    return MapError(distance, len(surveyed) - pairs, len(places) - pairs)


def chi2_bounds(runs: int, numbers: int, share: float = 0.95) -> tuple[float, float]:
    """Between what the average NEES of honest runs lies.

    Args:
        runs: how many are averaged, independent of each other.
        numbers: coordinates of the estimate: 2 for a place, 3 for a pose.
        share: how often it does.

    Example:
        >>> [round(bound, 2) for bound in chi2_bounds(50, 2)]
        [1.48, 2.59]
    """
    tail = (1 - share) / 2
    low, high = stats.chi2.ppf([tail, 1 - tail], runs * numbers) / runs
    return float(low), float(high)


def consistency(
    off: Shaped[np.ndarray, "runs steps k"] | Shaped[Array, "runs steps k"],
    covariance: Shaped[np.ndarray, "runs steps k k"] | Shaped[Array, "runs steps k k"],
) -> Consistency:
    """Average NEES over many runs of the same filter, against what is honest.

    Args:
        off: estimates less truth, angles wrapped, k coordinates.
        covariance: that was claimed of them. Where it is singular in any run (a start
            that is known, a cloud of one particle), that step counts as unknown.

    Note:
        Steps of one run are not independent. Read `inside` as a description, `mean`
        as the measure.
    """
    off, covariance = np.asarray(off, float), np.asarray(covariance, float)
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0))
    usable = np.asarray(np.all(sigma > 0, axis=-1))
    sigma = np.where(usable[..., None], sigma, 1.0)
    # In units of each σ, so that metres and radians can be compared.
    z = off / sigma
    correlation = covariance / (sigma[..., :, None] * sigma[..., None, :])
    size = off.shape[-1]
    usable = usable & (np.linalg.eigvalsh(correlation)[..., 0] > _SINGULAR)
    correlation = np.where(usable[..., None, None], correlation, np.eye(size))
    squares = np.sum(z * np.linalg.solve(correlation, z[..., None])[..., 0], axis=-1)
    average = np.where(usable, squares, np.nan).mean(axis=0)
    return Consistency(average, *chi2_bounds(len(off), size))


_SINGULAR = 1e-6  # smallest eigenvalue of a correlation that float32 can tell from 0
