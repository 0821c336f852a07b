r"""What one particle believes of the vehicle's pose: a mean and a covariance.

The FastSLAM family are three moves on this belief, in one order or another.

*Move* it by the controls: mean and covariance grow as an EKF's. *Draw* a coordinate
from it: the particle commits itself, its belief in the others is conditioned on the
number drawn, and the covariance of what is drawn is zero from then on. *Inform* it by
what is seen, in information form: detections add up to a matrix Λ and a vector η, so
their order does not matter.

A filter that draws the whole pose is FastSLAM, one that draws the heading only is
L-SLAM, one that draws nothing is EKF-SLAM. If the draw comes before the look, the
proposal is the motion model's (FastSLAM 1.0, L-SLAM); if after, it knows what was seen
(FastSLAM 2.0). The weight is the same in all: how likely the detections were, given
the belief before they were seen.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from fsmsm_jax import geometry
from fsmsm_jax.slam.planes import Sym2
from fsmsm_jax.slam.sensor import Sight
from fsmsm_jax.slam.vehicle import Increment

__all__ = ["PoseBelief", "draw", "evidence", "inform", "motion", "move", "seen_from"]

X, Y, HEADING = 0, 1, 2


class PoseBelief(NamedTuple):
    """Where one particle takes the vehicle to be."""

    mean: Float[Array, "3"]
    """[m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """[m, m, rad]²; rows of zeros for what has been drawn."""


def move(belief: PoseBelief, increment: Increment) -> PoseBelief:
    """The belief after a motion that is uncertain itself."""
    mean, carry, added = motion(belief.mean, increment)
    return PoseBelief(mean, _sandwich(carry, belief.covariance) + added)


def motion(
    pose: Float[Array, "3"], increment: Increment
) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, "3 3"]]:
    """The pose after a motion, its derivative by the one before, and added covariance.

    Example:
        >>> turned = Increment(jnp.array([1.0, 0.0, 0.5]), jnp.eye(3))
        >>> [round(float(x), 2) for x in motion(jnp.array([2.0, 3.0, 1.57]), turned)[0]]
        [2.0, 4.0, 2.07]
    """
    c, s = jnp.cos(pose[HEADING]), jnp.sin(pose[HEADING])
    ahead, left, _ = increment.pose
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    rows = lambda *entries: jnp.stack(entries).reshape(3, 3)
    turn = rows(c, -s, zero, s, c, zero, zero, zero, one)
    sideways = -(s * ahead + c * left), c * ahead - s * left
    carry = rows(one, zero, sideways[0], zero, one, sideways[1], zero, zero, one)
    added = _sandwich(turn, increment.covariance)
    return geometry.compose(pose, increment.pose), carry, added


def draw(
    mean: Float[Array, "numbers"],
    covariance: Float[Array, "numbers numbers"],
    coordinates: Sequence[int],
    normals: Float[Array, "3"],
) -> tuple[Float[Array, "numbers"], Float[Array, "numbers numbers"]]:
    """Commit to values of some coordinates, one after the other.

    Args:
        mean: of a Gaussian that begins with a pose.
        covariance: of it, of any rank.
        coordinates: which of the pose to draw, by index.
        normals: standard normal numbers, one for each coordinate of the pose.

    Returns:
        Mean and covariance, given the numbers drawn.

    Example:
        >>> whole = jnp.array([[2.0, 1.0], [1.0, 1.0]])  # x follows y
        >>> mean, left = draw(jnp.zeros(2), whole, [1], jnp.array([0.0, 3.0, 0.0]))
        >>> mean.tolist(), left.tolist()
        ([3.0, 3.0], [[1.0, 0.0], [0.0, 0.0]])
    """
    for index in coordinates:
        column = covariance[:, index]
        variance = column[index]
        sigma = jnp.sqrt(jnp.where(variance > 0, variance, 1.0))
        column = jnp.where(variance > 0, column / sigma, 0.0)
        mean = mean + column * normals[index]
        covariance = covariance - column[:, None] * column[None, :]
        gone = jnp.arange(mean.size) == index
        covariance = jnp.where(gone[:, None] | gone[None, :], 0.0, covariance)
    return mean, covariance


def seen_from(belief: PoseBelief, look: Sight, free: int) -> Sym2:
    """What the pose's uncertainty adds to the covariance of residuals [m²].

    Args:
        belief: of the pose.
        look: whose residuals.
        free: how many coordinates the belief leaves open: 0, 2 (position) or 3.
    """
    p = belief.covariance
    still = jnp.zeros_like(look.residual[0])
    if free == 0:
        return Sym2(still, still, still)
    if free == 2:
        return Sym2(still + p[X, X], still + p[X, Y], still + p[Y, Y])
    a, b = look.arm
    return Sym2(
        p[X, X] + 2 * a * p[X, HEADING] + a * a * p[HEADING, HEADING],
        p[X, Y] + a * p[Y, HEADING] + b * p[X, HEADING] + a * b * p[HEADING, HEADING],
        p[Y, Y] + 2 * b * p[Y, HEADING] + b * b * p[HEADING, HEADING],
    )


def evidence(look: Sight, spread: Sym2) -> Float[Array, "*shape"]:
    """Log-likelihood of each residual, given its covariance."""
    squares = spread.inverse().form(look.residual, look.residual)
    return look.log_scale - 0.5 * (squares + jnp.log(spread.determinant()) + _LOG_2PI_2)


_LOG_2PI_2 = 2 * math.log(2 * math.pi)  # of two numbers


def inform(
    belief: PoseBelief, look: Sight, spread: Sym2, used: Array, free: int
) -> tuple[PoseBelief, Float[Array, ""]]:
    r"""What detections tell of the pose, and how likely they were.

    With H = [1 0 arm_x; 0 1 arm_y] and residuals r of covariance C if the pose is
    right, Λ = Σ HᵀC⁻¹H and η = −Σ HᵀC⁻¹r; the belief becomes P⁺ = (P⁻¹ + Λ)⁻¹ with
    the mean moved by P⁺η, and the detections' log-likelihood is
    Σ log N(r; 0, C) + ½ ηᵀP⁺η − ½ log |1 + PΛ|: of all of them together, exactly.

    Args:
        belief: before.
        look: residuals, linear in the pose.
        spread: C, of each landmark and its detection without the pose's uncertainty.
        used: which of them there are.
        free: how many coordinates the belief leaves open: 0, 2 (position) or 3.
    """
    likely = jnp.sum(jnp.where(used, evidence(look, spread), 0.0))
    if free == 0:
        return belief, likely
    weigh = lambda entries: jnp.sum(jnp.where(used, entries, 0.0))
    inverse = spread.inverse()
    pull = inverse.times(look.residual)
    gain = [[weigh(inverse.xx), weigh(inverse.xy)], [None, weigh(inverse.yy)]]
    eta = [-weigh(pull[0]), -weigh(pull[1])]
    if free == 3:
        lever = inverse.times(look.arm)
        gain[0].append(weigh(lever[0]))
        gain[1].append(weigh(lever[1]))
        swing = look.arm[0] * lever[0] + look.arm[1] * lever[1]
        gain.append([None, None, weigh(swing)])
        eta.append(-weigh(look.arm[0] * pull[0] + look.arm[1] * pull[1]))

    # One scalar measurement for each column of a root of Λ: no inverse, any rank.
    covariance = belief.covariance
    for column in _columns(gain):
        column = jnp.stack([*column, *[jnp.zeros_like(likely)] * (3 - free)])
        moved = jnp.sum(covariance * column[None], axis=1)
        scale = 1 + jnp.sum(moved * column)
        covariance = covariance - moved[:, None] * moved[None, :] / scale
        likely = likely - 0.5 * jnp.log(scale)
    force = jnp.stack([*eta, *[jnp.zeros_like(likely)] * (3 - free)])
    step = jnp.sum(covariance * force[None], axis=1)
    likely = likely + 0.5 * jnp.sum(force * step)
    return PoseBelief(belief.mean + step, covariance), likely


def _columns(upper):
    """Columns of the lower triangular root of a matrix, given its upper part."""
    size, left = len(upper), [list(row) for row in upper]
    for i in range(size):
        diagonal = left[i][i]
        good = diagonal > 0
        root = jnp.sqrt(jnp.where(good, diagonal, 1.0))
        column = [jnp.zeros_like(root)] * i
        column += [jnp.where(good, left[i][j] / root, 0.0) for j in range(i, size)]
        for j in range(i + 1, size):
            for k in range(j, size):
                left[j][k] = left[j][k] - column[j] * column[k]
        yield column


def _sandwich(outer, inner):
    """A B Aᵀ, written as sums: small products are slow on CPUs when batched."""
    half = jnp.sum(outer[:, :, None] * inner[None], axis=1)
    return jnp.sum(half[:, None, :] * outer[None], axis=2)
