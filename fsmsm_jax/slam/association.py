r"""Which landmark is it? One particle's answer for all detections of a look.

Detections are taken one after the other, and each informs the belief before the next
is judged. A detection is compared with every landmark, the pose's uncertainty
included:

- inside the gate (Mahalanobis distance² of two numbers) it is one of those landmarks,
  the most likely one, or one drawn in proportion to the likelihoods. Drawn
  associations differ between particles, and resampling keeps those that were right:
  that is Monte Carlo association, where a particle's mistake dies with it;
- farther than a second, wider gate from all landmarks it is a new one;
- in between it is left alone: better no detection than a landmark twice.

No landmark is taken twice in a look. What is new or left alone is weighed as what it
is: one of the unmapped things, of which there are `density` a square metre. Without
that, a particle that explains nothing would outweigh one that explains well.

Source: J. Nieto, J. Guivant, E. Nebot, S. Thrun, "Real time data association for
FastSLAM", ICRA 2003; evidence of landmarks: M. Montemerlo's thesis, 2003, §3.5.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from fsmsm_jax.slam.belief import PoseBelief, evidence, inform, seen_from
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.landmarks import Landmarks, in_view
from fsmsm_jax.slam.planes import Sym2
from fsmsm_jax.slam.sensor import RangeBearing, Sight, displacement, sight

__all__ = [
    "Association",
    "Choice",
    "Luck",
    "Pairing",
    "associate",
    "astray",
    "by_id",
    "choose",
    "evidence_after",
    "luck_of",
    "named",
    "twins",
]


class Association(eqx.Module):
    """How detections find their landmarks where nobody says which is which."""

    gate: ScalarLike = 9.21
    """Largest Mahalanobis distance² to a landmark; 99 % of detections are within."""
    new: ScalarLike = 25.0
    """Smallest Mahalanobis distance² to all landmarks of a new one."""
    density: ScalarLike = 1e-3
    """Things not on the map, for each square metre in view [1/m²]."""
    drawn: bool = eqx.field(default=True, static=True)
    """Whether the landmark is drawn by likelihood (Monte Carlo) or the likeliest."""
    missed: ScalarLike = 0.02
    """Evidence that a landmark loses when it should have been found and was not: one
    over the looks after which a thing seen once is forgotten."""
    most: ScalarLike = 10.0
    """Evidence that a landmark can have; it earns 1 each time it is found."""


class Pairing(NamedTuple):
    """What became of the detections of one look."""

    detection: Int[Array, "slots"]
    """The detection of each slot, −1 for none."""
    belief: PoseBelief
    """Of the pose, informed by them."""
    log_likelihood: Float[Array, ""]
    """Of the detections, before they were seen."""
    unplaced: Int[Array, ""]
    """How many were new and found no free slot."""


class Luck(NamedTuple):
    """Random numbers for Monte Carlo association; zeros where nothing is drawn.

    The largest of log-likelihoods plus Gumbel numbers is a draw in proportion to the
    likelihoods. Fresh ones for each particle, detection and slot would cost more than
    all the rest, so each reads a stretch of one table, from a random start.
    """

    table: Float[Array, "numbers"]
    """Independent standard Gumbel numbers, or zeros."""
    start: Int[Array, "*shape detections"]
    """Where the stretch of each detection begins."""


def luck_of(
    key: PRNGKeyArray, rules: Association | None, detections: int, slots: int, many: int
) -> Luck:
    """Luck for many particles."""
    if rules is None or not rules.drawn:
        return Luck(jnp.zeros(slots), jnp.zeros((many, detections), int))
    one, other = jax.random.split(key)
    table = jax.random.gumbel(one, (slots + 1024,))
    start = jax.random.randint(other, (many, detections), 0, 1025)
    return Luck(table, start)


class Choice(NamedTuple):
    """What one detection is."""

    slot: Int[Array, ""]
    """Of the landmark it is, or where a new one goes."""
    matched: Bool[Array, ""]
    """Whether it is of a known landmark."""
    new: Bool[Array, ""]
    """Whether it starts a landmark."""
    unplaced: Bool[Array, ""]
    """Whether it would, had there been a free slot."""


def choose(
    rules: Association,
    look: Sight,
    spread: Sym2,
    known: Bool[Array, "slots"],
    vacant: Bool[Array, "slots"],
    luck: Luck,
) -> Choice:
    """Which landmark a detection is of, if any.

    Args:
        rules: gates.
        look: the detection against each slot.
        spread: covariance of each residual, all uncertainties included.
        known: which slots hold landmarks.
        vacant: which have no detection in this look.
        luck: of this detection, for Monte Carlo association.
    """
    apart = spread.inverse().form(look.residual, look.residual)
    apart = jnp.where(known, apart, jnp.inf)
    inside = vacant & (apart < rules.gate)
    score = jnp.where(inside, evidence(look, spread), -jnp.inf)
    # Once for all reductions, which would each compute them again.
    apart, inside, score = jax.lax.optimization_barrier((apart, inside, score))
    score = score + jax.lax.dynamic_slice_in_dim(luck.table, luck.start, known.size)
    best = jnp.argmax(score)
    matched = jnp.any(inside)
    far = ~matched & (jnp.min(apart) > rules.new)
    free = vacant & ~known
    room = jnp.any(free)
    slot = jnp.where(matched, best, jnp.argmax(free))
    return Choice(slot, matched, far & room, far & ~room)


def astray(
    rules: Association, detection: Float[Array, "2"], *, expected: bool
) -> Float[Array, ""]:
    """Log-likelihood of a detection that is of nothing on the map."""
    likely = jnp.log(rules.density)
    return likely + jnp.log(detection[0]) if expected else likely


def named(frame: Drive, slots: int) -> Int[Array, "detections"]:
    """The slot that each detection says it is of; −1 for none of them."""
    fits = frame.valid & (frame.ids < slots)
    return jnp.where(fits, frame.ids, -1)


def twins(
    sensor: RangeBearing, rules: Association | None, frame: Drive
) -> Bool[Array, "detections"]:
    """Which detections may be of the same thing as an earlier one of the look.

    They may find a landmark, but start none: else one thing would be there twice.
    """
    number = len(frame.valid)
    if rules is None:
        return jnp.zeros(number, bool)
    there, noise = displacement(sensor, jnp.zeros(()), jnp.asarray(frame.detections))
    apart = tuple(axis[:, None] - axis[None] for axis in there)
    both = jax.tree.map(lambda entry: entry[:, None] + entry[None], noise)
    near = both.inverse().form(apart, apart) < rules.new
    return jnp.any(jnp.tril(near & frame.valid[None], -1), axis=1)


def evidence_after(
    rules: Association | None,
    landmarks: Landmarks,
    found: Bool[Array, "slots"],
    pose: Float[Array, "3"],
    sensor: RangeBearing,
) -> Float[Array, "slots"]:
    """What is found earns evidence, what should have been found and was not loses some.

    Args:
        rules: how much; None where ids are believed, and nothing is lost.
        landmarks: before the look.
        found: which slots have a detection.
        pose: after the look.
        sensor: what it can find.
    """
    if rules is None:
        return jnp.where(found, 1.0, landmarks.evidence)
    missed = in_view(landmarks, pose, sensor) & ~found
    gain = jnp.where(found, 1.0, -jnp.where(missed, rules.missed, 0.0))
    return jnp.clip(landmarks.evidence + gain, 0.0, rules.most)


def by_id(
    landmarks: Landmarks,
    belief: PoseBelief,
    sensor: RangeBearing,
    frame: Drive,
    *,
    expected: bool,
    free: int,
) -> Pairing:
    """Pair detections with slots by their ids, and inform the belief by all at once.

    Args:
        landmarks: slot n holds landmark n.
        belief: of the pose before the look.
        sensor: its noise.
        frame: a step. Detections without an id, or with one that has no slot, are left
            alone; of two detections of one landmark the first counts. No gate: an id
            is believed, however far off its detection is.
        expected: where to linearise, see `sight`.
        free: coordinates that the belief leaves open: 0, 2 or 3.
    """
    slots = landmarks.evidence.size
    ids = named(frame, slots)
    same = ids[None, :] == jnp.arange(slots)[:, None]
    paired = jnp.where(jnp.any(same, axis=1), jnp.argmax(same, axis=1), -1)
    used = (paired >= 0) & landmarks.known
    seen = frame.detections[paired]
    look = sight(sensor, belief.mean, landmarks.place, seen, expected=expected)
    spread = landmarks.covariance.plus(look.noise)
    belief, likely = inform(belief, look, spread, used, free)
    return Pairing(paired, belief, likely, jnp.sum(frame.valid & (frame.ids >= slots)))


def associate(
    luck: Luck,
    rules: Association,
    landmarks: Landmarks,
    belief: PoseBelief,
    sensor: RangeBearing,
    frame: Drive,
    *,
    expected: bool,
    free: int,
) -> Pairing:
    """Pair detections with slots by where they are, informing the belief one by one.

    Args:
        luck: of each detection, for Monte Carlo association.
        rules: gates.
        landmarks: the map so far.
        belief: of the pose before the look.
        sensor: its noise.
        frame: a step.
        expected: where to linearise, see `sight`.
        free: coordinates that the belief leaves open: 0, 2 or 3.
    """
    slots = jnp.arange(landmarks.evidence.size)
    may_start = ~twins(sensor, rules, frame)

    def one(pairing, row):
        n, seen, there, alone, start = row
        look = sight(
            sensor, pairing.belief.mean, landmarks.place, seen, expected=expected
        )
        spread = landmarks.covariance.plus(look.noise)
        whole = spread.plus(seen_from(pairing.belief, look, free))
        vacant = pairing.detection < 0
        mine = luck._replace(start=start)
        choice = choose(rules, look, whole, landmarks.known, vacant, mine)
        matched, fresh = there & choice.matched, there & alone & choice.new

        at_slot = lambda tree: jax.tree.map(lambda a: a[choice.slot][None], tree)
        belief, likely = inform(
            pairing.belief, at_slot(look), at_slot(spread), matched[None], free
        )
        stray = jnp.where(there, astray(rules, seen, expected=expected), 0.0)
        return Pairing(
            jnp.where((matched | fresh) & (slots == choice.slot), n, pairing.detection),
            belief,
            pairing.log_likelihood + jnp.where(matched, likely, stray),
            pairing.unplaced + (there & alone & choice.unplaced),
        ), None

    none = jnp.full(slots.size, -1), belief, jnp.zeros(()), jnp.zeros((), int)
    order = jnp.arange(len(frame.valid))
    rows = order, frame.detections, frame.valid, may_start, luck.start
    return jax.lax.scan(one, Pairing(*none), rows)[0]
