"""A short drive past four landmarks, away from the origin, and filters for it.

The settings are arrays, so that filters of other numbers run the same program.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.slam import Car, Drive, RangeBearing, SlamConfig, init, step
from tests.oracles import slam as oracle

SIGMAS = (0.1, 0.02)
START = np.array([31.0, -17.0, 2.2])
PLACES = START[:2] + np.array([[-9.0, 6.0], [-2.0, 14.0], [-16.0, 9.0], [-6.0, 21.0]])
CONTROLS = np.array([[2.0, 0.2, 0.2], [2.2, 0.1, 0.2], [1.8, -0.15, 0.3]])
JOINT = ("ekf", "lslam_joint")


def car_rates(speed, steering):
    return oracle.acfr_rates(speed, steering, 2.83, 0.0, 0.0, 0.0)


SLOTS = 6  # two more than there are landmarks: what is never seen changes nothing


def drive(steps=5, straight=False, noise=1.0):
    """All landmarks at the first look, then three of them in any order."""
    rng = np.random.default_rng(7)
    controls = np.tile(CONTROLS * [1, not straight, 1], (steps, 1, 1))
    pose, detections, ids, valid = np.array(START), [], [], []
    for n in range(steps):
        said = controls[n] + noise * rng.normal(size=(3, 3)) * [
            0.2,
            0.0 if straight else 0.02,
            0,
        ]
        pose, _ = oracle.moved(
            pose, np.zeros((3, 3)), oracle.drive_on(car_rates, said), np.zeros((3, 3))
        )
        order = np.arange(4) if n == 0 else rng.permutation(4)
        seen = [oracle.sighted(pose, PLACES[j])[0] for j in order]
        detections.append(np.array(seen) + noise * rng.normal(size=(4, 2)) * SIGMAS)
        ids.append(order)
        valid.append(np.arange(4) < (4 if n == 0 else 3))
    numbers = controls, np.array(detections), np.array(valid), np.array(ids)
    return Drive(*map(jnp.asarray, numbers))


def frame(drive, n):
    return jax.tree.map(lambda a: a[n], drive)


def filter_of(method, association=None, particles=4, landmarks=SLOTS, **parts):
    parts = {"vehicle": Car(), "sensor": RangeBearing(SIGMAS), **parts}
    config = SlamConfig(method, particles, landmarks, association=association, **parts)
    return jax.tree.map(lambda a: jnp.asarray(a, float), config)


def begin(config, seed=3, start=START, covariance=None):
    return init(config, jax.random.key(seed), jnp.asarray(start, float), covariance)


def steps(config, drive, state=None):
    """Step by step; yields frame, state before, state after, info."""
    state = begin(config) if state is None else state
    for n in range(len(drive.valid)):
        after, info = step(config, state, frame(drive, n))
        yield frame(drive, n), state, after, info
        state = after


def looks(frame):
    """What a frame's ids say, as a list of (landmark, range and bearing)."""
    rows = np.flatnonzero(frame.valid)
    return [(int(frame.ids[n]), np.asarray(frame.detections[n])) for n in rows]


def randomness(state, particles):
    """Normals and the comb's offset that the next step will take."""
    _, *keys = jax.random.split(state.key, 4)
    normals = np.asarray(jax.random.normal(keys[0], (particles, 3)))
    return normals, float(jax.random.uniform(keys[2]))


def joint_map(particles, i):
    """Mean and covariance of pose and known landmarks of one joint particle."""
    known = np.flatnonzero(np.asarray(particles.evidence[i]) > 0)
    at = np.concatenate([[0, 1, 2], *([3 + 2 * k, 4 + 2 * k] for k in known)]).astype(
        int
    )
    mean, S = np.asarray(particles.mean[i]), np.asarray(particles.covariance[i])
    return mean[at], S[np.ix_(at, at)], known.tolist()


def places(landmarks, i):
    """{slot: (m, P)} of one particle."""
    return {
        int(k): (
            np.array([float(axis[i, k]) for axis in landmarks.place]),
            np.array(
                [
                    [landmarks.covariance.xx[i, k], landmarks.covariance.xy[i, k]],
                    [landmarks.covariance.xy[i, k], landmarks.covariance.yy[i, k]],
                ]
            ),
        )
        for k in np.flatnonzero(np.asarray(landmarks.known[i]))
    }
