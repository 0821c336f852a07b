r"""One particle with a filter for each landmark: FastSLAM and L-SLAM.

Given the vehicle's way, landmarks are independent, so a particle that has drawn its
pose needs two numbers and a 2 × 2 covariance for each, and a look costs O(M). That is
FastSLAM. L-SLAM draws the heading only; position and landmarks stay a linear problem,
whose position is shared by the landmarks (see `landmarks`): still O(M).

The paper writes a filter of four numbers, position and landmark, for each landmark
(equations 6 to 14), and leaves open how the filters share the position. Here the
position of one is handed to the next, as in the specification's reading; the sums of
`belief.inform` do it for all at once, with the same position, covariance and weight.
"""

from typing import NamedTuple

from jaxtyping import Array, Float

from fsmsm_jax.slam.association import (
    Association,
    Luck,
    Pairing,
    associate,
    by_id,
    evidence_after,
)
from fsmsm_jax.slam.belief import PoseBelief, draw, move
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.landmarks import Landmarks, correct, empty
from fsmsm_jax.slam.methods import Method
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Increment

__all__ = ["Particle", "advance", "blank"]


class Particle(NamedTuple):
    """One hypothesis: where the vehicle is and what is around it."""

    belief: PoseBelief
    landmarks: Landmarks


def blank(belief: PoseBelief, slots: int) -> Particle:
    """A pose and a map of nothing."""
    return Particle(belief, empty(slots))


def advance(
    method: Method,
    sensor: RangeBearing,
    rules: Association | None,
    moved: Increment,
    frame: Drive,
    particle: Particle,
    normals: Float[Array, "3"],
    luck: Luck,
) -> tuple[Particle, Pairing]:
    """One particle through one step of a drive.

    Args:
        method: what to draw, and when.
        sensor: its noise and view.
        rules: of association; None to believe ids.
        moved: what the controls did.
        frame: the step.
        particle: before.
        normals: standard normal numbers for the draws.
        luck: of each detection, for Monte Carlo association.

    Returns:
        The particle after, and what became of the detections.
    """
    belief, landmarks = particle
    belief = move(belief, moved)
    if not method.looks_first:
        belief = PoseBelief(*draw(*belief, method.draws, normals))
    how = {"expected": method.expected, "free": method.free}
    if rules is None:
        pairing = by_id(landmarks, belief, sensor, frame, **how)
    else:
        pairing = associate(luck, rules, landmarks, belief, sensor, frame, **how)
    belief = pairing.belief
    if method.looks_first:
        belief = PoseBelief(*draw(*belief, method.draws, normals))
    found = pairing.detection >= 0
    after = correct(
        landmarks,
        belief,
        sensor,
        frame.detections[pairing.detection],
        found,
        expected=method.expected,
        free=method.left,
    )
    rated = evidence_after(rules, landmarks, found, belief.mean, sensor)
    return Particle(belief, after._replace(evidence=rated)), pairing
