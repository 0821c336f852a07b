import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from jax.test_util import check_grads

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


def corners(seed, count=9):
    """A jagged star-shaped outline, tens of metres from the origin, counter-clockwise."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(0, 0.8, count)) / count
    radii = rng.uniform(1, 6, count)
    away = np.array([37.0, -52.0])
    return away + radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def painted(outline, cell=0.02):
    """Area and centroid by counting little squares whose middle lies inside."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    x, y = np.meshgrid(*(np.arange(a, b, cell) for a, b in zip(low, high, strict=True)))
    inside = np.zeros(x.shape, bool)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        straddles = (ay <= y) != (by <= y)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= straddles & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return inside.sum() * cell**2, np.array([x[inside].mean(), y[inside].mean()])


@pytest.mark.parametrize("seed", range(5))
def test_polygons_measure_what_painting_them_says(seed):
    outline = corners(seed)
    area, centroid = painted(outline)
    # The painted edge is off by half a cell of 2 cm at most, and mostly cancels.
    for turned, sign in ((outline, 1), (outline[::-1], -1)):
        vertices = jnp.asarray(turned, jnp.float32)
        assert float(geometry.polygon_area(vertices)) == pytest.approx(
            sign * area, rel=3e-3
        )
        np.testing.assert_allclose(
            geometry.polygon_centroid(vertices), centroid, atol=0.01
        )


def test_polygons_keep_their_digits_far_away():
    """An L of 3 m² a kilometre out: its centroid by its two boxes, exactly."""
    shape = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
    far = np.array([1024.0, -2048.0])  # exact in float32, as are the corners there
    vertices = jnp.asarray(shape + far, jnp.float32)
    centroid = far + (2 * np.array([1, 0.5]) + np.array([0.5, 1.5])) / 3
    assert float(geometry.polygon_area(vertices)) == pytest.approx(3, rel=1e-6)
    # One ulp of 2048 m is 2.4e-4 m: the answer itself cannot be written more exactly.
    np.testing.assert_allclose(geometry.polygon_centroid(vertices), centroid, atol=3e-4)
    with jax.enable_x64(True):
        exact = geometry.polygon_centroid(jnp.asarray(shape + far))
        assert exact.dtype == jnp.float64
        np.testing.assert_allclose(exact, centroid, rtol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_polygon_without_area_is_at_the_mean_of_its_vertices(count):
    along = np.linspace(0, 1, count)[:, None] * np.array([[3.1, -1.7]]) + [20.3, 7.9]
    line = np.concatenate([along, along[::-1]])  # there and back
    for dtype in (jnp.float32, jnp.float64):
        with jax.enable_x64(dtype == jnp.float64):
            vertices = jnp.asarray(line, dtype)
            value, slope = jax.jit(
                jax.value_and_grad(lambda v: geometry.polygon_centroid(v).sum())
            )(vertices)
            assert float(geometry.polygon_area(vertices)) == pytest.approx(0, abs=1e-4)
            assert float(value) == pytest.approx(line.mean(axis=0).sum(), rel=1e-6)
            assert np.isfinite(slope).all()


def test_polygon_derivatives_are_those_of_finite_differences():
    with jax.enable_x64(True):
        vertices = jnp.asarray(corners(3))
        for measure in (geometry.polygon_area, geometry.polygon_centroid):
            check_grads(jax.jit(measure), (vertices,), order=1, eps=1e-5)


def test_polygons_go_through_vmap():
    outlines = jnp.asarray(np.stack([corners(s) for s in range(3)]), jnp.float32)
    together = jax.jit(jax.vmap(geometry.polygon_centroid))(outlines)
    for one, outline in zip(together, outlines, strict=True):
        np.testing.assert_allclose(one, geometry.polygon_centroid(outline), rtol=1e-6)
