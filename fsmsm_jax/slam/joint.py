r"""One particle that keeps all correlations of pose and landmarks.

State is one vector, pose and all landmarks, with one covariance; each detection
updates all of it. That is EKF-SLAM if nothing is drawn; if the heading is drawn, it is
L-SLAM without its approximation: given the headings, everything is linear, and the
filter is exact (Rao-Blackwell). A detection costs O(M²) for M landmarks where
`factored` costs O(M): it is here to tell what that form loses.

Source: R. Smith, M. Self, P. Cheeseman, "Estimating uncertain spatial relationships in
robotics", 1990; its limit for known headings is the oracle of the tests.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fsmsm_jax.slam.association import (
    Association,
    Choice,
    Luck,
    Pairing,
    astray,
    choose,
    evidence_after,
    named,
    twins,
)
from fsmsm_jax.slam.belief import PoseBelief, draw, evidence, motion, seen_from
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.methods import Method
from fsmsm_jax.slam.planes import Sym2
from fsmsm_jax.slam.sensor import RangeBearing, Sight, displacement, sight
from fsmsm_jax.slam.vehicle import Increment

__all__ = ["Joint", "advance", "blank"]


class Joint(NamedTuple):
    """A pose and landmarks with their correlations."""

    mean: Float[Array, "*particles numbers"]
    """Pose [m, m, rad], then x, y of each slot [m]."""
    covariance: Float[Array, "*particles numbers numbers"]
    """Of it all; what it says of free slots means nothing."""
    evidence: Float[Array, "*particles slots"]
    """How sure it is that there is a landmark; 0 for a free slot."""

    @property
    def belief(self) -> PoseBelief:
        """Of the pose alone."""
        return PoseBelief(self.mean[..., :3], self.covariance[..., :3, :3])

    @property
    def landmarks(self) -> Landmarks:
        """Each landmark alone."""
        line = lambda offset: jnp.diagonal(
            self.covariance[..., 3:, 3:], offset, axis1=-2, axis2=-1
        )
        spread = Sym2(line(0)[..., ::2], line(1)[..., ::2], line(0)[..., 1::2])
        place = self.mean[..., 3::2], self.mean[..., 4::2]
        return Landmarks(place, spread, self.evidence)


def blank(belief: PoseBelief, slots: int) -> Joint:
    """A pose and a map of nothing."""
    size = 3 + 2 * slots
    covariance = jnp.eye(size).at[:3, :3].set(belief.covariance)
    mean = jnp.zeros(size).at[:3].set(belief.mean)
    return Joint(mean, covariance, jnp.zeros(slots))


def advance(
    method: Method,
    sensor: RangeBearing,
    rules: Association | None,
    moved: Increment,
    frame: Drive,
    particle: Joint,
    normals: Float[Array, "3"],
    luck: Luck,
) -> tuple[Joint, Pairing]:
    """One particle through one step of a drive: see `factored.advance`."""
    mean, covariance, _ = particle
    pose, carry, added = motion(mean[:3], moved)
    rows = carry @ covariance[:3]
    covariance = covariance.at[:3].set(rows).at[:, :3].set(rows.T)
    covariance = covariance.at[:3, :3].set(rows[:, :3] @ carry.T + added)
    mean = mean.at[:3].set(pose)
    if not method.looks_first:
        mean, covariance = draw(mean, covariance, method.draws, normals)

    particle = Joint(mean, covariance, particle.evidence)
    slots = jnp.arange(particle.evidence.size)
    ids = named(frame, slots.size)
    may_start = ~twins(sensor, rules, frame)

    def one(state, row):
        now, paired, likely, unplaced = state
        n, seen, there, alone, slot, start = row
        known, vacant = now.evidence > 0, paired < 0
        look = sight(
            sensor, now.mean[:3], now.landmarks.place, seen, expected=method.expected
        )
        if rules is None:
            there = there & (slot >= 0) & vacant[slot]
            choice = Choice(slot, known[slot], ~known[slot], jnp.zeros((), bool))
            stray = jnp.zeros(())
        else:
            mine = luck._replace(start=start)
            choice = choose(rules, look, _spread(now, look), known, vacant, mine)
            stray = astray(rules, seen, expected=method.expected)
        matched, fresh = there & choice.matched, there & alone & choice.new
        slot = choice.slot
        corrected, score = _correct(now, jax.tree.map(lambda a: a[slot], look), slot)
        started = _start(sensor, now, seen, slot)
        pick = lambda a, b, c: jnp.where(matched, a, jnp.where(fresh, b, c))
        return (
            jax.tree.map(pick, corrected, started, now),
            jnp.where((matched | fresh) & (slots == slot), n, paired),
            likely + jnp.where(matched, score, jnp.where(there, stray, 0.0)),
            unplaced + (there & alone & choice.unplaced),
        ), None

    lost = jnp.sum(frame.valid & (frame.ids >= slots.size)) if rules is None else 0
    none = jnp.full(slots.size, -1), jnp.zeros(()), jnp.asarray(lost, int)
    order = jnp.arange(len(ids))
    rows = order, frame.detections, frame.valid, may_start, ids, luck.start
    (after, paired, likely, unplaced), _ = jax.lax.scan(one, (particle, *none), rows)
    if method.looks_first:
        both = draw(after.mean, after.covariance, method.draws, normals)
        after = Joint(*both, after.evidence)
    found = paired >= 0
    rated = evidence_after(rules, particle.landmarks, found, after.mean[:3], sensor)
    after = after._replace(evidence=rated)
    return after, Pairing(paired, after.belief, likely, unplaced)


def _spread(particle: Joint, look: Sight) -> Sym2:
    """Covariance of a detection's residual against each slot, correlations included."""
    landmarks = particle.landmarks
    spread = landmarks.covariance.plus(look.noise)
    spread = spread.plus(seen_from(particle.belief, look, 3))
    # Less twice the correlation of a landmark with where it is seen from.
    across = particle.covariance[:3, 3:].reshape(3, -1, 2)
    x = across[0] + across[2] * look.arm[0][:, None]
    y = across[1] + across[2] * look.arm[1][:, None]
    both = Sym2(2 * x[:, 0], x[:, 1] + y[:, 0], 2 * y[:, 1])
    return spread.minus(both)


def _correct(particle: Joint, look: Sight, slot: Array) -> tuple[Joint, Array]:
    """Everything, corrected by one landmark's residual, and how likely that was."""
    mean, covariance, known = particle
    at = 3 + 2 * slot
    arm = jnp.stack(look.arm)
    columns = jax.lax.dynamic_slice_in_dim(covariance, at, 2, axis=1)
    columns = covariance[:, :2] + covariance[:, 2:3] * arm[None] - columns
    rows = jax.lax.dynamic_slice_in_dim(columns, at, 2, axis=0)
    spread = columns[:2] + arm[:, None] * columns[2][None] - rows
    spread = Sym2(spread[0, 0], spread[0, 1], spread[1, 1]).plus(look.noise)
    inverse = spread.inverse()
    pull = jnp.stack(inverse.times(look.residual))
    weight = jnp.stack(
        [jnp.stack([inverse.xx, inverse.xy]), jnp.stack([inverse.xy, inverse.yy])]
    )
    covariance = covariance - columns @ weight @ columns.T
    after = Joint(mean - columns @ pull, (covariance + covariance.T) / 2, known)
    return after, evidence(look, spread)


def _start(sensor: RangeBearing, particle: Joint, seen: Array, slot: Array) -> Joint:
    """A new landmark, correlated with the pose that it was seen from."""
    mean, covariance, known = particle
    at = 3 + 2 * slot
    offset, noise = displacement(sensor, mean[2], seen)
    offset = jnp.stack(offset)
    arm = jnp.stack([-offset[1], offset[0]])
    rows = covariance[:2] + arm[:, None] * covariance[2][None]
    rows = jax.lax.dynamic_update_slice_in_dim(rows, jnp.zeros((2, 2)), at, axis=1)
    own = rows[:, :2] + rows[:, 2:3] * arm[None]
    own = own + jnp.array([[noise.xx, noise.xy], [noise.xy, noise.yy]])
    rows = jax.lax.dynamic_update_slice_in_dim(rows, own, at, axis=1)
    put = jax.lax.dynamic_update_slice_in_dim
    covariance = put(put(covariance, rows, at, axis=0), rows.T, at, axis=1)
    mean = put(mean, mean[:2] + offset, at, axis=0)
    return Joint(mean, covariance, known.at[slot].set(1.0))
