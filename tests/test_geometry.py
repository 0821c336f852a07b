import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from fsmsm_jax import geometry

# Exact in float32, and far from the origin: errors are some ulps of 1000 m (6e-5 m).
metres = st.floats(-1000, 1000, width=32)
radians = st.floats(-10, 10, width=32)
poses = st.tuples(metres, metres, radians).map(lambda p: jnp.array(p, jnp.float32))


def matrix(pose):
    """The homogeneous matrix of a pose, in float64: the textbook's SE(2)."""
    x, y, theta = np.asarray(pose, float)
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def assert_same_pose(pose, expected, atol=1e-3):
    np.testing.assert_allclose(matrix(pose), expected, atol=atol)
    assert -np.pi - 1e-6 <= pose[2] <= np.pi + 1e-6


@given(poses, poses)
def test_compose_is_the_product_of_matrices(a, b):
    assert_same_pose(geometry.compose(a, b), matrix(a) @ matrix(b))


@given(poses)
def test_inverse_is_the_inverse_matrix(a):
    assert_same_pose(geometry.inverse(a), np.linalg.inv(matrix(a)), atol=2e-3)


@given(poses, poses)
def test_between_undoes_compose(a, b):
    assert_same_pose(geometry.between(a, geometry.compose(a, b)), matrix(b), atol=4e-3)


@given(poses, metres, metres)
def test_points_transform_like_matrices(a, x, y):
    point = jnp.array([x, y], jnp.float32)
    expected = (matrix(a) @ [x, y, 1])[:2]
    np.testing.assert_allclose(
        geometry.transform_points(a, point), expected, atol=1e-3, rtol=0
    )


@given(st.floats(-100, 100, width=32))
def test_wrap_keeps_the_direction_and_lands_in_one_turn(angle):
    wrapped = float(geometry.wrap(jnp.float32(angle)))
    assert np.float32(-np.pi) <= wrapped < np.float32(np.pi)
    # Both ends of the comparison carry an ulp of 100 rad, 8e-6.
    assert np.hypot(
        np.cos(wrapped) - np.cos(angle), np.sin(wrapped) - np.sin(angle)
    ) == pytest.approx(0, abs=5e-5)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 3])
@pytest.mark.parametrize("ulps", [-2, -1, 0, 1, 2])
def test_wrap_at_the_seam(turns, ulps):
    seam = np.float32((2 * turns + 1) * np.pi)
    angle = seam + ulps * np.spacing(seam)
    wrapped = float(geometry.wrap(jnp.float32(angle)))
    assert np.float32(-np.pi) <= wrapped < np.float32(np.pi)


def test_poses_keep_batch_axes_and_precision():
    a = jnp.array([[3.0, -8.0, 2.5], [70.0, 1.0, -3.0]])
    b = jnp.array([[1.0, 2.0, 1.5], [0.5, -4.0, -2.0]])
    batched = jax.jit(jax.vmap(geometry.compose))(a, b)
    for i in range(2):
        np.testing.assert_allclose(batched[i], geometry.compose(a[i], b[i]), rtol=1e-6)
    points = jnp.arange(24.0).reshape(3, 4, 2)
    moved = geometry.transform_points(a[0], points)
    assert moved.shape == (3, 4, 2)
    np.testing.assert_allclose(
        moved[2, 1], geometry.transform_points(a[0], points[2, 1]), rtol=1e-6
    )
    with jax.enable_x64(True):
        exact = geometry.compose(jnp.asarray(np.asarray(a[0], float)), jnp.ones(3))
        assert exact.dtype == jnp.float64


def test_pose_derivatives_are_finite_at_zero_and_at_the_seam():
    for theta in (0.0, np.pi, -np.pi):
        pose = jnp.array([1.0, 2.0, theta])
        jacobian = jax.jacfwd(geometry.compose)(pose, jnp.array([3.0, 4.0, 0.0]))
        c, s = np.cos(theta), np.sin(theta)
        expected = [[1, 0, -3 * s - 4 * c], [0, 1, 3 * c - 4 * s], [0, 0, 1]]
        np.testing.assert_allclose(jacobian, expected, atol=1e-5)
