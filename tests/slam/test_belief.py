"""What one look tells: against full matrices, and against integrals over a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.slam import RangeBearing
from fsmsm_jax.slam.belief import PoseBelief, draw, inform, seen_from
from fsmsm_jax.slam.planes import Sym2
from fsmsm_jax.slam.sensor import sight
from tests.oracles import slam as oracle

POSE = np.array([31.0, -17.0, 2.2])
PLACES = np.array([[22.0, -11.0], [29.0, -3.0], [15.0, -8.0]])
SPREAD = np.array([[0.05, 0.01, 0.02], [0.02, -0.01, 0.03], [0.4, 0.2, 0.3]])
SIGMAS = (0.1, 0.01)


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def full(xx, xy, yy):
    return np.array([[xx, xy], [xy, yy]])


def seen():
    """Detections a little off the places."""
    z = np.array([oracle.sighted(POSE, m)[0] for m in PLACES])
    return z + np.array([[0.2, -0.03], [-0.1, 0.02], [0.15, 0.01]])


def looked(expected, pose=POSE):
    places = tuple(map(jnp.asarray, PLACES.T))
    look = sight(
        RangeBearing(SIGMAS),
        jnp.asarray(pose),
        places,
        jnp.asarray(seen()),
        expected=expected,
    )
    spread = Sym2(*map(jnp.asarray, SPREAD.T)).plus(look.noise)
    return look, spread


@pytest.mark.parametrize("expected", [False, True], ids=["detected", "expected"])
def test_a_residual_moves_with_the_pose_as_its_arm_says(expected):
    """By position one to one, by heading `arm`: central differences.

    Where the landmark is expected, range and bearing are linearised, so the slopes are
    those of a residual of zero; they differ by the residual itself, 0.4 m."""
    h = 1e-6
    slopes = [
        (np.array(looked(expected, POSE + h * e)[0].residual)
         - np.array(looked(expected, POSE - h * e)[0].residual)) / (2 * h)
        for e in np.eye(3)
    ]  # fmt: skip
    arm = np.array(looked(expected)[0].arm)
    near = {"atol": 1e-7} if not expected else {"atol": 0.4}
    np.testing.assert_allclose(slopes[2], arm, **near)
    np.testing.assert_allclose(
        slopes[0], [[1] * 3, [0] * 3], atol=1e-7 if not expected else 0.05
    )
    np.testing.assert_allclose(
        slopes[1], [[0] * 3, [1] * 3], atol=1e-7 if not expected else 0.05
    )


def test_where_it_is_expected_it_is_the_textbooks_innovation():
    """Turned along the ray: Δd and d Δθ, and likelihoods are of range and bearing."""
    look, spread = looked(True)
    P = np.diag([0.04, 0.05, 0.003]) + 0.002
    added = seen_from(PoseBelief(jnp.asarray(POSE), jnp.asarray(P)), look, 3)
    for k, (m, z) in enumerate(zip(PLACES, seen(), strict=True)):
        zh, by_pose, by_landmark = oracle.sighted(POSE, m)
        v = oracle.innovation(POSE, m, z)
        T = oracle.turn(zh[1] + POSE[2]) @ np.diag([1, zh[0]])
        residual = np.array([look.residual[0][k], look.residual[1][k]])
        np.testing.assert_allclose(residual, T @ v, atol=1e-12)
        S = by_landmark @ full(*SPREAD[k]) @ by_landmark.T + np.diag(np.square(SIGMAS))
        found = full(*(np.asarray(entry)[k] for entry in spread))
        np.testing.assert_allclose(found, T @ S @ T.T, atol=1e-12)
        found = full(*(np.asarray(entry)[k] for entry in added))
        np.testing.assert_allclose(found, T @ by_pose @ P @ by_pose.T @ T.T, atol=1e-12)
        alone = inform(
            PoseBelief(jnp.asarray(POSE), jnp.zeros((3, 3))),
            look,
            spread,
            jnp.arange(3) == k,
            0,
        )[1]
        np.testing.assert_allclose(alone, oracle.log_normal(v, S), rtol=1e-12)


@pytest.mark.parametrize("expected", [False, True], ids=["detected", "expected"])
@pytest.mark.parametrize("free", [0, 2, 3])
@pytest.mark.parametrize("used", [[1, 1, 1], [0, 1, 0], [0, 0, 0]])
@pytest.mark.parametrize("rank", [1, 3])
def test_informed_by_all_at_once(free, expected, used, rank):
    """A Kalman update with all residuals stacked; priors may be singular."""
    look, spread = looked(expected)
    root = np.array([[0.3, 0.1, 0.02], [0.0, 0.2, 0.1], [0.0, 0.0, 0.05]])[:, :rank]
    root = root * (np.arange(3) < free)[:, None]
    P, at = root @ root.T, np.flatnonzero(used)
    belief = PoseBelief(jnp.asarray(POSE), jnp.asarray(P))
    found, likely = inform(belief, look, spread, jnp.asarray(used, bool), free)
    if not len(at):
        assert float(likely) == 0
        np.testing.assert_allclose(found.mean, POSE, atol=0)
        np.testing.assert_allclose(found.covariance, P, atol=0)
        return
    r = np.array(look.residual).T[at]
    arm = np.array(look.arm).T[at]
    H = np.concatenate([np.column_stack([np.eye(2), a]) for a in arm])
    C = np.zeros((len(H), len(H)))
    for row, k in enumerate(at):
        C[2 * row : 2 * row + 2, 2 * row : 2 * row + 2] = full(
            *(np.asarray(e)[k] for e in spread)
        )
    Z = H @ P @ H.T + C
    K = P @ H.T @ np.linalg.inv(Z)
    np.testing.assert_allclose(found.mean, POSE - K @ r.ravel(), atol=1e-12)
    np.testing.assert_allclose(found.covariance, P - K @ Z @ K.T, atol=1e-12)
    scale = np.sum(np.asarray(look.log_scale)[at])
    np.testing.assert_allclose(
        likely, oracle.log_normal(r.ravel(), Z) + scale, rtol=1e-11
    )


@pytest.mark.parametrize("coordinates", [(2,), (2, 0, 1)])
def test_draws_are_cholesky_s(coordinates):
    """The rest follows as it should: conditional mean and covariance."""
    P = np.array(
        [
            [0.3, 0.1, 0.02, 0.1],
            [0.1, 0.2, 0.01, 0.05],
            [0.02, 0.01, 0.05, 0.03],
            [0.1, 0.05, 0.03, 0.4],
        ]
    )
    mean, normals = np.append(POSE, 5.0), np.array([0.3, -1.2, 0.7])
    found, left = draw(*map(jnp.asarray, (mean, P)), coordinates, jnp.asarray(normals))
    at, rest = list(coordinates), [i for i in range(4) if i not in coordinates]
    value = mean[at] + np.linalg.cholesky(P[np.ix_(at, at)]) @ normals[at]
    gain = P[np.ix_(rest, at)] @ np.linalg.inv(P[np.ix_(at, at)])
    np.testing.assert_allclose(np.asarray(found)[at], value, rtol=1e-12)
    np.testing.assert_allclose(
        np.asarray(found)[rest], mean[rest] + gain @ (value - mean[at]), rtol=1e-12
    )
    expected = np.zeros((4, 4))
    expected[np.ix_(rest, rest)] = P[np.ix_(rest, rest)] - gain @ P[np.ix_(at, rest)]
    np.testing.assert_allclose(left, expected, atol=1e-12)


def test_what_is_certain_is_not_drawn():
    found, left = draw(jnp.asarray(POSE), jnp.zeros((3, 3)), (2, 0, 1), jnp.ones(3))
    np.testing.assert_array_equal(found, POSE)
    np.testing.assert_array_equal(left, np.zeros((3, 3)))


PRIOR = np.array(
    [[0.02, 0.004, 0.001], [0.004, 0.015, 0.0008], [0.001, 0.0008, 0.0004]]
)


def test_fastslam2_proposes_the_posterior():
    """Of pose given range and bearing of one landmark, integrated over a grid."""
    place, own, z = PLACES[0], full(0.03, 0.01, 0.02), seen()[0]
    poses, log_mass = oracle.grid(POSE, PRIOR)
    log_post = np.empty(len(poses))
    R = np.diag(np.square(SIGMAS))
    for i, pose in enumerate(poses):
        _, _, H = oracle.sighted(pose, place)
        log_post[i] = oracle.log_normal(
            oracle.innovation(pose, place, z), H @ own @ H.T + R
        )
    check_against_grid(poses, log_post + log_mass, place, own, z, expected=True)


def test_lslam2_proposes_the_posterior():
    """The heading's, position integrated out; and the position's, given the heading."""
    place, own, z = PLACES[0], full(0.03, 0.01, 0.02), seen()[0]
    poses, log_mass = oracle.grid(POSE, PRIOR)
    log_post = np.empty(len(poses))
    for i, pose in enumerate(poses):
        there, R = oracle.displaced(pose[2], z, SIGMAS)
        log_post[i] = oracle.log_normal(there - place + pose[:2], own + R)
    check_against_grid(poses, log_post + log_mass, place, own, z, expected=False)


def check_against_grid(poses, log_post, place, own, z, *, expected):
    evidence = np.logaddexp.reduce(log_post)
    mass = np.exp(log_post - evidence)
    mean = mass @ poses
    covariance = (poses - mean).T @ ((poses - mean) * mass[:, None])

    sensor, at = RangeBearing(SIGMAS), tuple(jnp.asarray(a)[None] for a in place)
    look = sight(sensor, jnp.asarray(POSE), at, jnp.asarray(z)[None], expected=expected)
    spread = Sym2(*(jnp.full(1, a) for a in (own[0, 0], own[0, 1], own[1, 1]))).plus(
        look.noise
    )
    prior = PoseBelief(jnp.asarray(POSE), jnp.asarray(PRIOR))
    found, likely = inform(prior, look, spread, jnp.ones(1, bool), 3)
    # The model is bent over the prior: 9 m by headings of 0.02 rad, 2 mm of 100 mm.
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((found.mean - mean) / sigma, 0, atol=0.05)
    np.testing.assert_allclose(
        found.covariance / np.outer(sigma, sigma),
        covariance / np.outer(sigma, sigma),
        atol=0.05,
    )
    np.testing.assert_allclose(likely, evidence, atol=0.05)

    above = found.mean[2] + jnp.sqrt(found.covariance[2, 2])
    drawn, left = draw(*found, (2,), jnp.array([9.0, 9.0, 1.0]))
    position, tighter = oracle.given_heading(mean, covariance, float(above))
    np.testing.assert_allclose(drawn[2], above, rtol=1e-12)
    np.testing.assert_allclose((drawn[:2] - position) / sigma[:2], 0, atol=0.1)
    np.testing.assert_allclose(
        left[:2, :2] / sigma[0] ** 2, tighter / sigma[0] ** 2, atol=0.05
    )
