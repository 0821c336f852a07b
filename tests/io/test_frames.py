import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.io.frames import (
    Mounts,
    between,
    chain,
    compose,
    interpolate,
    matrix,
    yaw,
)

FLAT = np.array([0.0, 0.0, 0.0, 1.0])


def poses(count, seed=0):
    return np.random.default_rng(seed).uniform(-3.125, 3.125, (count, 3))


def same(found, expected, atol=1e-5):
    difference = np.asarray(found) - np.asarray(expected)
    difference[..., 2] = np.mod(difference[..., 2] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=atol)


def test_composition_is_that_of_geometry():
    a, b = poses(20), poses(20, 1)
    single = jnp.asarray(a), jnp.asarray(b)
    same(compose(a, b), jax.vmap(geometry.compose)(*single))
    same(between(a, b), jax.vmap(geometry.between)(*single))
    same(
        compose(a, b[0]), jax.vmap(geometry.compose, (0, None))(single[0], single[1][0])
    )
    same(compose(a, between(a, b)), b, 1e-12)


def test_motions_chain_to_the_poses_they_came_from():
    way = poses(50)
    same(chain(way[0], between(way[:-1], way[1:])), way, 1e-12)
    same(chain(way[0], np.zeros((0, 3))), way[:1])


def test_interpolation_between_messages_in_any_order():
    times = np.array([2.0, 1.0, np.nan, 1.5, 1.25])
    known = np.array([[2, 0, 0.5], [0, 0, 0], [9, 9, 9], [1, 1, 0.25], [np.nan, 0, 0]])
    found = interpolate(np.array([1.75, 1.0, 2.0, 1.25]), times, known)
    expected = [[1.5, 0.5, 0.375], [0, 0, 0], [2, 0, 0.5], [0.5, 0.5, 0.125]]
    np.testing.assert_allclose(found, expected)


def test_interpolation_takes_the_shorter_way_round():
    known = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    found = interpolate(np.array([0.25, 0.75]), np.array([0.0, 1.0]), known, 1.0)
    quarter = (2 * np.pi - 6) / 4
    np.testing.assert_allclose(found[:, 2], [3 + quarter, -3 - quarter])


def test_interpolation_knows_nothing_outside_and_in_gaps():
    times = np.array([1.0, 1.4, 2.0])
    known = np.array([[1.0, 0, 0], [1.4, 0, 0], [2.0, 0, 0]])
    found = interpolate(np.array([0.99, 1.0, 1.2, 1.4, 1.7, 2.0, 2.01]), times, known)
    np.testing.assert_allclose(
        found[:, 0], [np.nan, 1.0, 1.2, 1.4, np.nan, 2.0, np.nan]
    )
    nothing = interpolate(np.array([1.0]), np.zeros(0), np.zeros((0, 3)))
    assert np.isnan(nothing).all()


def test_yaw_of_a_quaternion_of_any_length():
    heading = np.array([-3.0, -0.5, 0.0, 2.0])
    zeros = np.zeros(4)
    flat = np.stack([zeros, zeros, np.sin(heading / 2), np.cos(heading / 2)], -1)
    np.testing.assert_allclose(yaw(3 * flat), heading, atol=1e-12)
    assert np.isnan(yaw(np.zeros((1, 4)))).all()
    assert np.isnan(yaw(np.full((1, 4), np.nan))).all()


def test_mounts_lead_over_a_common_part():
    mounts = Mounts()
    turn = np.array([0.0, 0.0, np.sin(0.25), np.cos(0.25)])
    mounts.add("base", "lidar", matrix(np.array([9.0, 9.0, 9.0]), FLAT))
    mounts.add("base", "lidar", matrix(np.array([1.0, 0.0, 0.5]), turn))
    mounts.add("base", "wheel", matrix(np.array([0.0, 1.0, 0.0]), turn))
    mounts.add("wheel", "broken", matrix(np.zeros(3), np.zeros(4)))
    assert mounts.root("lidar") == "base"
    assert "broken" not in mounts
    pose, upside_down = mounts.find("wheel", "lidar")
    expected = between(np.array([0.0, 1.0, 0.5]), np.array([1.0, 0.0, 0.5]))
    np.testing.assert_allclose(pose, expected, atol=1e-12)
    assert not upside_down
    assert mounts.find("elsewhere", "lidar") is None
    np.testing.assert_array_equal(mounts.find("lidar", "lidar")[0], np.zeros(3))


def test_mounts_in_a_circle_end():
    mounts = Mounts()
    mounts.add("a", "b", np.eye(4))
    mounts.add("b", "a", np.eye(4))
    assert mounts.find("a", "b") is not None
    assert mounts.find("c", "b") is None


@pytest.mark.parametrize("yaw_angle", [0.0, 0.75])
def test_an_upside_down_lidar_is_the_mirror_of_an_upright_one(yaw_angle):
    roll = np.array([np.cos(yaw_angle / 2), np.sin(yaw_angle / 2), 0.0, 0.0])
    T = matrix(np.array([0.5, 0.25, 1.0]), roll)
    mounts = Mounts()
    mounts.add("base", "lidar", T)
    pose, upside_down = mounts.find("base", "lidar")
    assert upside_down
    bearing = 0.375
    point = T @ [np.cos(bearing), np.sin(bearing), 0, 1]
    heading = pose[2] - bearing
    np.testing.assert_allclose(
        point[:2], pose[:2] + [np.cos(heading), np.sin(heading)], atol=1e-12
    )


def test_slight_tilt_is_none():
    mounts = Mounts()
    for angle, child in ((0.1, "slight"), (0.5, "much")):
        tilt = np.array([np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2)])
        mounts.add("base", child, matrix(np.zeros(3), tilt))
    np.testing.assert_allclose(mounts.find("base", "slight")[0], 0, atol=1e-12)
    with pytest.raises(ValueError, match="much is tilted by 29° against base"):
        mounts.find("base", "much")
