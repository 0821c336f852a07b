"""The odometry model: samples, their covariance, and amcl's own words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation.motion import OdometryModel, lidar_poses, sample, spread

CLEAN = {"floor": (0.0, 0.0), "drift": (0.0, 0.0)}
MOTIONS = {
    "straight": [0.4, 0.0, 0.0],
    "bend": [0.3, 0.05, 0.3],
    "backwards": [-0.4, 0.02, -0.1],
    "turn": [0.0, 0.0, 0.8],
    "aside": [0.1, 0.3, 0.2],
}


def amcl(rng, motion, alpha, count):
    """odometry_diff_corrected of amcl's source, one delta after the other."""
    trans = np.hypot(motion[0], motion[1])
    rot1 = np.arctan2(motion[1], motion[0]) if trans >= 0.01 else 0.0
    rot2 = np.angle(np.exp(1j * (motion[2] - rot1)))
    noise1 = min(abs(rot1), abs(np.angle(np.exp(1j * (rot1 - np.pi)))))
    noise2 = min(abs(rot2), abs(np.angle(np.exp(1j * (rot2 - np.pi)))))
    draw = lambda variance: rng.normal(0, np.sqrt(variance), count)
    rot1_hat = rot1 - draw(alpha * noise1**2 + alpha * trans**2)
    trans_hat = trans - draw(alpha * trans**2 + alpha * noise1**2 + alpha * noise2**2)
    rot2_hat = rot2 - draw(alpha * noise2**2 + alpha * trans**2)
    x, y = trans_hat * np.cos(rot1_hat), trans_hat * np.sin(rot1_hat)
    turn = rot1_hat + rot2_hat - motion[2]
    return np.stack([x, y, motion[2] + np.angle(np.exp(1j * turn))], axis=1)


def drawn(model, motion, count=20_000):
    keys = jax.random.split(jax.random.key(0), count)
    motion = jnp.asarray(motion, float)
    found = np.array(jax.vmap(sample, (0, None, None))(keys, model, motion))
    off = found[:, 2] - motion[2]
    found[:, 2] = np.asarray(motion)[2] + np.angle(np.exp(1j * off))
    return found


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_amcl_draws_the_same(motion):
    found = drawn(OdometryModel.amcl(0.05), motion)
    theirs = amcl(np.random.default_rng(0), motion, 0.05, 20_000)
    np.testing.assert_allclose(found.mean(axis=0), theirs.mean(axis=0), atol=6e-3)
    ours, others = np.cov(found.T), np.cov(theirs.T)
    sigma = np.sqrt(np.diag(others))
    assert np.all(np.abs(ours - others) <= 0.04 * np.outer(sigma, sigma) + 1e-9)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("clean", [False, True])
def test_spread_is_the_covariance_of_samples(motion, clean):
    model = OdometryModel(0.05, 0.03, 0.05, 0.02, **(CLEAN if clean else {}))
    found = np.cov(drawn(model, motion).T)
    expected = np.asarray(spread(model, jnp.asarray(motion, float)))
    np.testing.assert_allclose(
        found, expected, rtol=0.08, atol=0.03 * np.trace(expected)
    )
    np.testing.assert_allclose(expected, expected.T, atol=1e-9)
    assert np.linalg.eigvalsh(expected).min() > -1e-9


def test_no_motion_no_error_but_the_floor():
    still = jnp.zeros(3)
    model = OdometryModel(**CLEAN)
    # But a nanometre, which keeps derivatives finite.
    found = sample(jax.random.key(0), model, still)
    np.testing.assert_allclose(found, 0, atol=1e-7)
    np.testing.assert_allclose(spread(model, still), 0, atol=1e-14)
    found = np.diag(spread(OdometryModel(floor=(0.1, 0.2)), still))
    np.testing.assert_allclose(found, [0.01, 0.01, 0.04], rtol=1e-5)


def test_drift_does_not_mind_how_often_one_looks():
    model = OdometryModel(0.0, 0.0, 0.0, 0.0, (0.0, 0.0), (0.1, 0.02))
    one = spread(model, jnp.asarray([1.0, 0.0, 0.0]))
    tenth = spread(model, jnp.asarray([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(10 * np.diag(tenth), np.diag(one), rtol=1e-4)


@pytest.mark.parametrize("model", [OdometryModel(), OdometryModel.amcl()])
@pytest.mark.parametrize("motion", [[0.0, 0.0, 0.0], *MOTIONS.values()])
def test_derivatives_are_numbers(model, motion):
    """A robot that stands does not move in vain: its drift has no slope but a value."""
    motion = jnp.asarray(motion, float)
    draw = lambda motion: sample(jax.random.key(0), model, motion)
    covariance = lambda motion, model: spread(model, motion)
    for f in (draw, lambda motion: covariance(motion, model)):
        assert np.isfinite(jax.jacfwd(f)(motion)).all()
        assert np.isfinite(jax.jacrev(f)(motion)).all()
    slopes = jax.jacrev(covariance, 1)(motion, model)
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


def test_backwards_is_as_sure_as_forwards():
    """Half a turn of the robot's axes: the same way, the same errors."""
    for x, y, turn in ([0.4, 0.05, 0.1], [0.2, -0.1, -0.3]):
        there = spread(OdometryModel(), jnp.asarray([x, y, turn]))
        back = spread(OdometryModel(), jnp.asarray([-x, -y, turn]))
        signs = np.array([-1.0, -1.0, 1.0])
        expected = np.asarray(there) * np.outer(signs, signs)
        np.testing.assert_allclose(back, expected, rtol=1e-4, atol=1e-8)


def test_drawn_headings_are_wrapped():
    found = drawn_raw(OdometryModel(turn_per_turn=1.0), [0.0, 0.0, 3.0])
    assert (found >= -np.pi).all()
    assert (found < np.pi).all()
    assert found.min() < -2.5 < 2.5 < found.max()


def drawn_raw(model, motion):
    keys = jax.random.split(jax.random.key(1), 500)
    return np.asarray(
        jax.vmap(sample, (0, None, None))(keys, model, jnp.asarray(motion))
    )[:, 2]


def test_jit_vmap_and_float64_agree():
    model, motion = OdometryModel(), jnp.asarray(MOTIONS["bend"], float)
    for f in (jax.jit(spread), lambda m, x: jax.vmap(spread, (None, 0))(m, x[None])[0]):
        np.testing.assert_allclose(f(model, motion), spread(model, motion), rtol=1e-5)
    with jax.enable_x64(True):
        wide = spread(model, jnp.asarray(MOTIONS["bend"], jnp.float64))
        assert wide.dtype == jnp.float64
    np.testing.assert_allclose(wide, spread(model, motion), rtol=1e-4, atol=1e-9)


def test_lidar_poses_are_composed():
    mount = jnp.asarray([0.2, -0.1, 3.0])
    bases = jnp.asarray([[12.0, -7.0, 3.1], [0.5, 40.0, -2.0]])
    found = lidar_poses(bases, mount)
    for one, base in zip(found, bases, strict=True):
        np.testing.assert_allclose(one, geometry.compose(base, mount), rtol=1e-5)


def test_negative_alpha():
    with pytest.raises(ValueError, match="not negative"):
        OdometryModel.amcl(-0.1)
