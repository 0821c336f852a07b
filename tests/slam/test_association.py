"""Which landmark a detection is: gates, draws, twins, full maps, evidence."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.slam import Association, Drive, RangeBearing
from fsmsm_jax.slam.association import (
    associate,
    by_id,
    choose,
    evidence_after,
    luck_of,
    named,
    twins,
)
from fsmsm_jax.slam.belief import PoseBelief
from fsmsm_jax.slam.landmarks import Landmarks, empty, in_view
from fsmsm_jax.slam.planes import Sym2
from fsmsm_jax.slam.sensor import sight
from tests.oracles import slam as oracle

POSE = np.array([31.0, -17.0, 2.2])
SIGMAS, VARIANCE = (0.1, 0.01), 0.01
SENSOR = RangeBearing(SIGMAS)
RULES = Association(drawn=False)
POSITION = np.diag([0.02, 0.03, 0.0])
L_SLAM = {"expected": False, "free": 2}


def at(ahead, left):
    """A point [m] in front of the vehicle, on the map."""
    return POSE[:2] + oracle.turn(POSE[2]) @ [ahead, left]


def mapped(*points, evidence=1.0, slots=4):
    """Landmarks of 0.1 m, then free slots."""
    places = np.zeros((slots, 2))
    places[: len(points)] = points
    known = np.arange(slots) < len(points)
    spread = Sym2(*(jnp.full(slots, a) for a in (VARIANCE, 0.0, VARIANCE)))
    place = tuple(jnp.asarray(a, float) for a in places.T)
    return Landmarks(place, spread, jnp.asarray(evidence * known, float))


def look_at(*points, ids=None):
    """One frame that detects points exactly, padded to four."""
    seen = np.array([oracle.sighted(POSE, p)[0] for p in points]).reshape(-1, 2)
    valid = np.arange(4) < len(points)
    seen = np.concatenate([seen, np.tile([1.0, 0.0], (4 - len(points), 1))])
    ids = np.full(4, -1) if ids is None else np.array([*ids, *[-1] * (4 - len(ids))])
    return Drive(
        jnp.zeros((1, 3)),
        jnp.asarray(seen, float),
        jnp.asarray(valid),
        jnp.asarray(ids),
    )


@jax.jit
def paired(rules, landmarks, frame):
    belief = PoseBelief(jnp.asarray(POSE, float), jnp.asarray(POSITION, float))
    luck = luck_of(jax.random.key(0), rules, 4, landmarks.evidence.size, 1)
    mine = luck._replace(start=luck.start[0])
    return associate(mine, rules, landmarks, belief, SENSOR, frame, **L_SLAM)


def spread_at(point):
    """Covariance of z' less the displacement: equation (14)'s Z."""
    z = oracle.sighted(POSE, point)[0]
    return (
        POSITION[:2, :2]
        + VARIANCE * np.eye(2)
        + oracle.displaced(POSE[2], z, SIGMAS)[1]
    )


def off_by(distance, point):
    """A point at this Mahalanobis distance from a landmark, as seen from the vehicle."""
    direction = np.array([0.6, 0.8])
    away = np.array(point)
    for _ in range(20):  # the noise is that of where the detection points
        size = np.sqrt(direction @ np.linalg.inv(spread_at(away)) @ direction)
        away = point + direction * distance / size
    return away


def test_the_nearest_in_likelihood_is_taken():
    near, far = at(8.0, 1.0), at(8.0, 2.2)
    found = paired(RULES, mapped(near, far), look_at(at(8.0, 1.3), at(8.0, 2.5)))
    assert found.detection.tolist() == [0, 1, -1, -1]
    assert int(found.unplaced) == 0


@pytest.mark.parametrize(
    ("distance", "expected"),
    [(2.99, "matched"), (3.08, "dropped"), (4.95, "dropped"), (5.05, "new")],
)
def test_gates(distance, expected):
    """9.21 = 3.03² and 25 = 5²; what is dropped or new weighs as an unmapped thing."""
    landmark = at(9.0, -2.0)
    point = off_by(distance, landmark)
    found = paired(RULES, mapped(landmark), look_at(point))
    slots = {"matched": [0, -1, -1, -1], "dropped": [-1] * 4, "new": [-1, 0, -1, -1]}
    assert found.detection.tolist() == slots[expected]
    likely = oracle.log_normal(point - landmark, spread_at(point))
    expected = likely if expected == "matched" else np.log(1e-3)
    # float32: displacements of 10 m in 36 m coordinates, 2e-6 m of 0.1 m.
    np.testing.assert_allclose(found.log_likelihood, expected, atol=2e-3)


def test_no_landmark_is_taken_twice():
    """The second detection is nearer, but the first came first: it starts no other."""
    landmark = at(9.0, 0.0)
    found = paired(RULES, mapped(landmark), look_at(at(9.2, 0.0), at(9.0, 0.0)))
    assert found.detection.tolist() == [0, -1, -1, -1]


def test_twins_start_one_landmark():
    points = at(9.0, 0.0), at(9.2, 0.0), at(9.0, 5.0)
    assert twins(SENSOR, RULES, look_at(*points)).tolist() == [
        False,
        True,
        False,
        False,
    ]
    assert twins(SENSOR, None, look_at(*points)).tolist() == [False] * 4
    found = paired(RULES, empty(4), look_at(*points))
    assert found.detection.tolist() == [0, 2, -1, -1]
    # An earlier one that is not valid is nobody's twin.
    frame = look_at(*points)
    frame = frame._replace(valid=frame.valid.at[0].set(False))
    assert twins(SENSOR, RULES, frame).tolist() == [False] * 4


def test_a_full_map_says_so():
    points = [at(6.0 + 3 * n, (-1) ** n * n) for n in range(4)]
    found = paired(
        RULES, mapped(*points), look_at(at(5.0, 4.0), points[2], at(15.0, -9.0))
    )
    assert found.detection.tolist() == [-1, -1, 1, -1]
    assert int(found.unplaced) == 2


def test_free_slots_are_filled_from_the_first():
    landmarks = mapped(at(6.0, 0.0), at(9.0, 3.0), at(12.0, -2.0))
    landmarks = landmarks._replace(evidence=jnp.array([1.0, 0.0, 1.0, 0.0]))
    found = paired(RULES, landmarks, look_at(at(15.0, 5.0), at(18.0, -3.0)))
    assert found.detection.tolist() == [-1, 0, -1, 1]
    assert int(found.unplaced) == 0


def test_monte_carlo_draws_by_likelihood():
    """Two landmarks in the gate, one taken, one far: of 40 tables of 500 particles.

    Particles that read one table are not independent: at least 40 × 100 draws count,
    and a share of them errs by 0.8 %; five of these.
    """
    points = [at(8.0, 0.0), at(8.0, 0.5), at(8.0, 0.3), at(20.0, 0.0)]
    landmarks, point = mapped(*points), at(8.0, 0.2)
    rules = Association()
    seen = jnp.asarray(oracle.sighted(POSE, point)[0], float)
    look = sight(
        SENSOR, jnp.asarray(POSE, float), landmarks.place, seen, expected=False
    )
    whole = spread_at(point)
    spread = Sym2(*(jnp.full(4, a) for a in (whole[0, 0], whole[0, 1], whole[1, 1])))
    vacant = jnp.array([True, True, False, True])

    @jax.jit
    @jax.vmap
    def slots(key):
        luck = luck_of(key, rules, 1, 4, 500)
        one = partial(choose, rules, look, spread, landmarks.known, vacant)
        pick = jax.vmap(lambda start: one(luck._replace(start=start[0])).slot)
        return pick(luck.start)

    drawn = np.bincount(
        np.ravel(slots(jax.random.split(jax.random.key(0), 40))), minlength=4
    )
    likely = np.exp([oracle.log_normal(point - p, whole) for p in points]) * [
        1,
        1,
        0,
        0,
    ]
    np.testing.assert_allclose(drawn / drawn.sum(), likely / likely.sum(), atol=0.04)
    assert 0.2 < likely[1] / likely.sum() < 0.8  # otherwise nothing is tested


def test_ids_are_believed():
    """The first of two counts; ids beyond the slots are counted, −1 is left alone."""
    points = at(8.0, 0.0), at(8.0, 0.2), at(5.0, 3.0), at(4.0, 1.0)
    frame = look_at(*points, ids=[2, 2, 7, -1])
    assert named(frame, 4).tolist() == [2, 2, -1, -1]
    belief = PoseBelief(jnp.asarray(POSE, float), jnp.asarray(POSITION, float))
    found = jax.jit(lambda: by_id(empty(4), belief, SENSOR, frame, **L_SLAM))()
    assert found.detection.tolist() == [-1, -1, 0, -1]
    assert int(found.unplaced) == 1
    assert float(found.log_likelihood) == 0
    np.testing.assert_array_equal(found.belief.mean, belief.mean)


def test_evidence_comes_and_goes():
    """Found, missed in view, missed behind, missed beyond reach."""
    points = at(8.0, 0.0), at(8.0, 3.0), at(-8.0, 0.0), at(40.0, 0.0)
    landmarks, pose = mapped(*points, evidence=0.05), jnp.asarray(POSE, float)
    assert in_view(landmarks, pose, SENSOR).tolist() == [True, True, False, False]
    found = jnp.array([True, False, False, False])
    rated = evidence_after(RULES, landmarks, found, pose, SENSOR)
    np.testing.assert_allclose(rated, [1.05, 0.03, 0.05, 0.05], rtol=1e-6)
    for _ in range(2):
        landmarks = landmarks._replace(evidence=rated)
        rated = evidence_after(RULES, landmarks, found, pose, SENSOR)
    np.testing.assert_allclose(rated, [3.05, 0, 0.05, 0.05], rtol=1e-6)
    for _ in range(8):
        landmarks = landmarks._replace(evidence=rated)
        rated = evidence_after(RULES, landmarks, found, pose, SENSOR)
    assert rated[0] == 10
    assert landmarks.known.tolist() == [True, False, True, True]
    believed = evidence_after(None, landmarks, found, pose, SENSOR)
    np.testing.assert_allclose(believed, [1, 0, 0.05, 0.05], rtol=1e-6)
