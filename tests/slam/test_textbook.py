"""Every filter, step by step, against the textbook's, with the same random numbers.

Then in its limits and symmetries; all in float64.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.resampling import systematic
from fsmsm_jax.slam import (
    METHODS,
    Association,
    Car,
    Drive,
    RangeBearing,
    increment,
    step,
)
from tests.oracles import slam as oracle
from tests.slam.scene import (
    SIGMAS,
    START,
    begin,
    drive,
    filter_of,
    frame,
    joint_map,
    looks,
    places,
    randomness,
    steps,
)

TIGHT = {"rtol": 1e-9, "atol": 1e-10}  # float64 sums of a few thousand terms


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def weighed(log_weight, likely, offset, below=0.75):
    """Normalised weights, evidence, and which particle each is a copy of."""
    total = np.asarray(log_weight) + likely
    evidence = np.logaddexp.reduce(total)
    weights = np.exp(total - evidence)
    chosen = np.arange(len(weights))
    if 1 / np.sum(weights**2) < below * len(weights):
        chosen = np.repeat(chosen, oracle.rsr(weights, offset / len(weights)))
        return weights, np.full(len(weights), -np.log(len(weights))), chosen
    return weights, total - evidence, chosen


def assert_maps_agree(landmarks, i, expected):
    found = places(landmarks, i)
    assert sorted(found) == sorted(expected)
    for name, (m, P) in expected.items():
        np.testing.assert_allclose(found[name][0], m, **TIGHT)
        np.testing.assert_allclose(found[name][1], P, **TIGHT)


def test_fastslam1():
    config, again = filter_of("fastslam1"), 0
    poses, maps = np.tile(START, (4, 1)), [{} for _ in range(4)]
    for now, before, after, info in steps(config, drive()):
        move = increment(config.vehicle, now.controls)
        normals, offset = randomness(before, 4)
        likely = np.zeros(4)
        for i in range(4):
            mean, P = oracle.moved(poses[i], np.zeros((3, 3)), *map(np.asarray, move))
            poses[i] = oracle.drawn(mean, P, (2, 0, 1), normals[i])
            likely[i] = oracle.fastslam1(poses[i], maps[i], looks(now), SIGMAS)
        weights, log_weight, chosen = weighed(before.log_weight, likely, offset)
        np.testing.assert_allclose(info.pose, poses[np.argmax(weights)], **TIGHT)
        poses, maps = poses[chosen], [dict(maps[k]) for k in chosen]
        again += list(chosen) != [0, 1, 2, 3]
        np.testing.assert_allclose(after.particles.belief.mean, poses, **TIGHT)
        np.testing.assert_allclose(after.log_weight, log_weight, **TIGHT)
        for i in range(4):
            assert_maps_agree(after.particles.landmarks, i, maps[i])
    assert again > 0


@pytest.mark.parametrize(
    "association", [None, Association(drawn=False)], ids=["ids", "ml"]
)
def test_lslam(association):
    """All detections at once and one by one are the paper's filters of four numbers."""
    config, again = filter_of("lslam", association), 0
    particles = [(START, np.zeros((3, 3)), {}) for _ in range(4)]
    for now, before, after, _ in steps(config, drive()):
        move = increment(config.vehicle, now.controls)
        normals, offset = randomness(before, 4)
        likely, moved = np.zeros(4), []
        for i, (pose, P, landmarks) in enumerate(particles):
            mean, P = oracle.moved(pose, P, *map(np.asarray, move))
            heading = mean[2] + np.sqrt(P[2, 2]) * normals[i, 2]
            position, P = oracle.given_heading(mean, P, heading)
            chained = dict(landmarks)
            one = oracle.four_state(position, P, heading, chained, looks(now), SIGMAS)
            known = [name for name, _ in looks(now) if name in landmarks]
            two = oracle.all_at_once(
                position, P, heading, landmarks, looks(now), SIGMAS
            )
            for a, b in zip(one, two, strict=True):
                np.testing.assert_allclose(a, b, **TIGHT)
            for name in known[-1:]:
                np.testing.assert_allclose(
                    chained[name][0], landmarks[name][0], **TIGHT
                )
                np.testing.assert_allclose(
                    chained[name][1], landmarks[name][1], **TIGHT
                )
            whole = np.zeros((3, 3))
            whole[:2, :2] = one[1]
            moved.append((np.append(one[0], heading), whole, landmarks))
            likely[i] = one[2]
        _, log_weight, chosen = weighed(before.log_weight, likely, offset)
        again += list(chosen) != [0, 1, 2, 3]
        particles = [(moved[k][0], moved[k][1], dict(moved[k][2])) for k in chosen]
        np.testing.assert_allclose(after.log_weight, log_weight, **TIGHT)
        for i, (pose, P, landmarks) in enumerate(particles):
            np.testing.assert_allclose(after.particles.belief.mean[i], pose, **TIGHT)
            np.testing.assert_allclose(after.particles.belief.covariance[i], P, **TIGHT)
            assert_maps_agree(after.particles.landmarks, i, landmarks)
    assert again > 0


def test_lslam_joint():
    """Heading drawn, the rest one dense Kalman filter: no correlation is lost."""
    config, again = filter_of("lslam_joint"), 0
    particles = [(START, np.zeros((3, 3)), []) for _ in range(4)]
    for now, before, after, _ in steps(config, drive()):
        move = increment(config.vehicle, now.controls)
        normals, offset = randomness(before, 4)
        likely, moved = np.zeros(4), []
        for i, (mean, S, names) in enumerate(particles):
            size = len(mean)
            pose, P = oracle.moved(mean[:3], S[:3, :3], *map(np.asarray, move))
            mean, S = np.concatenate([pose, mean[3:]]), S.copy()
            # The heading was drawn: landmarks correlate with the position alone.
            S[:3, :3] = P
            heading = pose[2] + np.sqrt(P[2, 2]) * normals[i, 2]
            gain = S[:, 2] / S[2, 2]
            mean, S = mean + gain * (heading - pose[2]), S - np.outer(gain, S[2])
            rest = [0, 1, *range(3, size)]
            m, C, likely[i], names = oracle.dense(
                mean[rest], S[np.ix_(rest, rest)], names, heading, looks(now), SIGMAS
            )
            mean = np.concatenate([m[:2], [heading], m[2:]])
            S = np.insert(np.insert(C, 2, 0.0, axis=0), 2, 0.0, axis=1)
            moved.append((mean, S, names))
        _, log_weight, chosen = weighed(before.log_weight, likely, offset)
        again += list(chosen) != [0, 1, 2, 3]
        particles = [moved[k] for k in chosen]
        np.testing.assert_allclose(after.log_weight, log_weight, **TIGHT)
        for i, (mean, S, names) in enumerate(particles):
            found, spread, known = joint_map(after.particles, i)
            assert names == known == [0, 1, 2, 3]  # the first look saw them in order
            np.testing.assert_allclose(found, mean, **TIGHT)
            np.testing.assert_allclose(spread, S, **TIGHT)
    assert again > 0


def test_ekf():
    config = filter_of("ekf")
    about = np.diag([0.04, 0.02, 0.003]) + 0.002
    mean, S, names = START, about, []
    state = begin(config, covariance=jnp.asarray(about))
    for now, _, after, info in steps(config, drive(), state):
        move, added = map(np.asarray, increment(config.vehicle, now.controls))
        pose, added = oracle.moved(mean[:3], np.zeros((3, 3)), move, added)
        F = np.eye(len(mean))
        F[:2, 2] = oracle.turn(mean[2]) @ np.array([-move[1], move[0]])
        mean, S = np.concatenate([pose, mean[3:]]), F @ S @ F.T
        S[:3, :3] += added
        mean, S, names, likely = oracle.ekf(mean, S, names, looks(now), SIGMAS)
        found, spread, known = joint_map(after.particles, 0)
        assert names == known
        np.testing.assert_allclose(found, mean, **TIGHT)
        np.testing.assert_allclose(spread, S, **TIGHT)
        np.testing.assert_allclose(info.log_evidence, likely, rtol=1e-8, atol=1e-8)


def known_heading(noise):
    """A straight drive: without noise of steering the heading is known."""
    return {
        "vehicle": Car(noise=(0.4 * noise, 0.0)),
        "sensor": RangeBearing((SIGMAS[0] * noise, SIGMAS[1] * noise)),
    }


def test_headings_that_are_known_are_alike():
    """All particles are one Kalman filter, and none outweighs another."""
    log = drive(straight=True)
    config = filter_of("lslam_joint", **known_heading(1.0))
    for *_, after, _ in steps(config, log):
        np.testing.assert_allclose(after.log_weight, -np.log(4), atol=1e-9)
        for a in jax.tree.leaves(after.particles):
            np.testing.assert_allclose(a, np.broadcast_to(a[:1], a.shape), atol=1e-12)


def test_lslam_is_ekf_slam_where_headings_are_known():
    """In units of the claimed σ they differ by the noise, to first order: bearings are
    linearised at the detection and at the expectation."""

    def apart(noise):
        log = drive(straight=True, noise=noise)
        parts = known_heading(noise)
        *_, (_, _, one, _) = steps(filter_of("lslam_joint", **parts), log)
        *_, (_, _, two, _) = steps(filter_of("ekf", **parts), log)
        a, S, _ = joint_map(one.particles, 0)
        b, T, _ = joint_map(two.particles, 0)
        at = [0, 1, *range(3, 11)]
        sigma = np.sqrt(np.diag(S)[at])
        covariances = np.abs((S - T)[np.ix_(at, at)]) / np.outer(sigma, sigma)
        return np.max(np.abs(a - b)[at] / sigma), np.max(covariances)

    coarse, fine = apart(0.1), apart(0.01)
    assert max(fine) < 2e-3
    assert fine[0] < coarse[0] / 5
    assert fine[1] < coarse[1] / 5


@pytest.mark.parametrize("motions", [1, 2])
def test_a_look_that_tells_nothing_changes_nothing(motions):
    """FastSLAM 2.0 draws from the motion model then, and all weigh the same."""
    one, two = filter_of("fastslam1"), filter_of("fastslam2")
    log = drive()
    state, _ = step(one, begin(one), frame(log, 0))
    blind = RangeBearing((1e6, 1e6))
    dull = lambda config: filter_of(config.method, sensor=blind)
    for n in range(1, 1 + motions):
        expected, _ = step(dull(one), state, frame(log, n))
        state, info = step(dull(two), state, frame(log, n))
        np.testing.assert_allclose(
            state.particles.belief.mean, expected.particles.belief.mean, atol=1e-6
        )
        np.testing.assert_allclose(state.log_weight, -np.log(4), atol=1e-6)
        np.testing.assert_allclose(info.effective, 4, rtol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_the_comb_is_bolics(seed):
    weights = np.random.default_rng(seed).dirichlet(np.full(50, 0.3))
    key = jax.random.key(seed)
    chosen = np.asarray(systematic(key, jnp.asarray(weights), 50))
    copies = np.bincount(chosen, minlength=50)
    assert copies.tolist() == oracle.rsr(weights, float(jax.random.uniform(key)) / 50)
    assert copies.sum() == 50
    assert np.all(np.abs(copies - 50 * weights) < 1)


MOTION = np.array([12.0, -7.0, 0.9])


@pytest.mark.parametrize("method", METHODS)
def test_the_world_moved_moves_the_answer(method):
    """Rigidly; but FastSLAM draws along the map's axes, so its draws do not turn."""
    motion = MOTION * ([1, 1, 0] if method.startswith("fastslam") else [1, 1, 1])
    config, log = filter_of(method), drive()
    motion = jnp.asarray(motion)
    there = geometry.compose(motion, jnp.asarray(START))
    here = list(steps(config, log))
    moved = list(steps(config, log, begin(config, start=there)))
    onward = jax.jit(jax.vmap(partial(geometry.compose, motion)))
    for (_, _, a, one), (_, _, b, two) in zip(here, moved, strict=True):
        expected, found = onward(a.particles.belief.mean), b.particles.belief.mean
        np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-9)
        turned = geometry.wrap(found[:, 2] - expected[:, 2])
        np.testing.assert_allclose(turned, 0, atol=1e-9)
        np.testing.assert_allclose(a.log_weight, b.log_weight, atol=1e-9)
        np.testing.assert_allclose(one.log_evidence, two.log_evidence, atol=1e-8)
    points = jnp.stack(a.particles.landmarks.place, -1)[:, :4]
    np.testing.assert_allclose(
        jnp.stack(b.particles.landmarks.place, -1)[:, :4],
        geometry.transform_points(motion, points),
        atol=1e-9,
    )


@pytest.mark.parametrize("method", ["fastslam2", "lslam", "lslam2", "lslam_joint"])
def test_no_order_of_detections_or_landmarks(method):
    """`ekf` alone takes detections one by one where they are expected to be."""
    config, log = filter_of(method), drive()
    names = np.array([2, 0, 3, 1, 5, 4])
    shuffled = log._replace(ids=jnp.asarray(names)[log.ids])
    shuffled = Drive(log.controls, *(a[:, ::-1] for a in shuffled[1:]))
    *_, (_, _, a, one) = steps(config, log)
    *_, (_, _, b, two) = steps(config, shuffled)
    np.testing.assert_allclose(one.pose, two.pose, atol=1e-10)
    np.testing.assert_allclose(one.covariance, two.covariance, atol=1e-10)
    np.testing.assert_allclose(a.log_weight, b.log_weight, atol=1e-9)
    first, second = a.particles.landmarks, b.particles.landmarks
    for x, y in zip(
        first.place + first.covariance, second.place + second.covariance, strict=True
    ):
        np.testing.assert_allclose(x, y[:, names], atol=1e-10)


def test_weights_that_say_nothing_stay():
    """A look that no particle can explain changes no weight."""
    config = filter_of("fastslam1")
    state, _ = step(config, begin(config), frame(drive(), 0))
    state = state._replace(log_weight=jnp.log(jnp.array([0.3, 0.3, 0.2, 0.2])))
    hopeless = frame(drive(), 1)
    hopeless = hopeless._replace(detections=hopeless.detections.at[:, 0].set(1e200))
    after, info = step(config, state, hopeless)
    assert not bool(info.usable)
    np.testing.assert_allclose(after.log_weight, state.log_weight, atol=1e-6)
    np.testing.assert_allclose(info.log_evidence, 0, atol=1e-6)


def test_float32_is_good_enough():
    """Of EKF-SLAM, which nothing random touches and which has the largest matrices.

    Coordinates of 40 m hold 2e-6 m in float32; five looks add some tens of these.
    """

    def last():
        *_, (_, _, state, info) = steps(filter_of("ekf"), drive())
        return info.pose, info.covariance, jnp.stack(state.particles.landmarks.place)

    double = last()
    with jax.enable_x64(False):
        single = last()
    assert {a.dtype for a in single} == {jnp.dtype("float32")}
    assert {a.dtype for a in double} == {jnp.dtype("float64")}
    for a, b, close in zip(single, double, (1e-4, 1e-5, 1e-4), strict=True):
        np.testing.assert_allclose(a, b, atol=close)
