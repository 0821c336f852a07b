"""The bound against finite differences and closed forms; errors by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.metrics import (
    cramer_rao_bound,
    nees,
    pose_errors,
    position_rms,
    success,
)
from fsmsm_jax.world import PolygonMap
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE, l_room, rasterised_room, square_room

SIGMA = 0.05
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, 360, endpoint=False)
POSE = jnp.array([*(CENTRE + [0.3, -0.2]), 0.7])


def bound(world, pose=POSE, bearings=BEARINGS, range_max=30.0, sigma=SIGMA):
    return np.asarray(
        jax.jit(cramer_rao_bound)(world, pose, bearings, range_max, sigma), float
    )


def test_errors_are_distance_and_shorter_angle():
    pose = jnp.array([[12.3, -7.4, 3.1], [12.5, -7.25, 0.2]])
    reference = jnp.array([[12.0, -7.0, -3.1], [12.5, -7.25, 0.5]])
    position, orientation = pose_errors(pose, reference)
    np.testing.assert_allclose(position, [0.5, 0.0], atol=1e-5)
    np.testing.assert_allclose(orientation, [2 * np.pi - 6.2, 0.3], atol=1e-5)


def test_errors_do_not_depend_on_the_frame():
    move = jnp.array([-20.0, 35.0, 2.5])
    other = POSE + jnp.array([0.3, 0.1, -0.4])
    moved = pose_errors(geometry.compose(move, POSE), geometry.compose(move, other))
    np.testing.assert_allclose(moved, pose_errors(POSE, other), atol=1e-5)


@pytest.mark.parametrize(
    ("error", "limits", "right"),
    [
        ([0.2, 0.2, 0.08], {}, True),
        ([0.2, 0.25, 0.0], {}, False),  # 0.32 m
        ([0.0, 0.0, -0.09], {}, False),  # 5.2°
        ([0.2, 0.25, 0.0], {"position": 0.5}, True),
        ([0.0, 0.0, -0.09], {"orientation": 0.1}, True),
        ([np.nan, 0.0, 0.0], {}, False),
    ],
)
def test_success_needs_both(error, limits, right):
    assert bool(success(POSE + jnp.array(error), POSE, **limits)) is right


@pytest.mark.parametrize("world", [square_room(), l_room()])
def test_bound_is_the_inverse_information_of_finite_differences(world):
    def cast(pose):
        start, end = np.asarray(world.start, float), np.asarray(world.end, float)
        headings = pose[2] + np.asarray(BEARINGS, float)
        return cast_walls(start, end, pose[:2], headings, 30.0)

    pose = np.asarray(POSE, float)
    steps = 1e-6 * np.eye(3)
    J = np.stack([(cast(pose + h) - cast(pose - h)) / 2e-6 for h in steps], axis=1)
    smooth = np.abs(J).max(axis=1) < 10  # neither grazing (capped) nor across a jump
    assert smooth.mean() > 0.9
    expected = np.linalg.inv(J[smooth].T @ J[smooth] / SIGMA**2)
    np.testing.assert_allclose(
        bound(world, bearings=BEARINGS[smooth]), expected, rtol=2e-3, atol=1e-9
    )


def test_circle_fixes_the_position_and_leaves_the_heading():
    angles = 2 * np.pi * np.arange(360) / 360
    corners = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    circle = PolygonMap.from_outlines(corners + CENTRE)
    # Rays meet the middles of the 360 walls at right angles: r = R − n·(x, y).
    centre = jnp.array([*CENTRE, 0.0])
    covariance = bound(circle, centre, jnp.asarray(angles + np.pi / 360, jnp.float32))
    np.testing.assert_allclose(
        covariance[:2, :2], 2 * SIGMA**2 / 360 * np.eye(2), rtol=1e-3, atol=1e-8
    )
    assert covariance[2, 2] > 0.5 * np.pi**2
    np.testing.assert_allclose(
        position_rms(jnp.asarray(covariance)), 2 * SIGMA / np.sqrt(360), rtol=1e-3
    )


def test_corridor_leaves_the_way_along_it():
    along = np.array([np.cos(0.4), np.sin(0.4)])
    across = np.array([-along[1], along[0]])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = signs * [[400.0, 1.0]] @ np.stack([along, across])
    covariance = bound(PolygonMap.from_outlines(corners + CENTRE))[:2, :2]
    assert along @ covariance @ along == pytest.approx(100, rel=0.1)
    # The 100 m² along it leave 1e-5 of rounding in float32.
    assert abs(across @ covariance @ across) < SIGMA**2


def test_bound_scales_with_the_variance_and_turns_with_the_world():
    one = bound(l_room())
    np.testing.assert_allclose(bound(l_room(), sigma=3 * SIGMA), 9 * one, rtol=1e-3)
    move = jnp.array([5.0, -2.0, 1.1])
    world = l_room()
    turned = PolygonMap(
        geometry.transform_points(move, world.start),
        geometry.transform_points(move, world.end),
    )
    c, s = np.cos(1.1), np.sin(1.1)
    T = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        bound(turned, geometry.compose(move, POSE)), T @ one @ T.T, rtol=0.02, atol=1e-7
    )


def test_bound_on_a_grid_is_near_the_polygons():
    grid, room = rasterised_room(0.3)
    rms = lambda world: float(position_rms(jnp.asarray(bound(world))))
    assert rms(grid) == pytest.approx(rms(room), rel=0.15)


def test_no_echo_is_no_information():
    covariance = bound(square_room(), range_max=0.5)
    np.testing.assert_allclose(covariance, np.diag([100.0, 100.0, np.pi**2]), rtol=1e-4)


def test_nees_of_honest_claims_averages_three():
    """χ² with 3 degrees of freedom: 2 000 draws leave √(6/2000) = 0.055 on the mean."""
    rng = np.random.default_rng(0)
    root = np.array([[0.02, 0, 0], [0.01, 0.03, 0], [0.001, -0.002, 0.004]])
    reference = np.column_stack([rng.uniform(-20, 20, (2000, 2)), np.full(2000, 3.14)])
    pose = reference + rng.standard_normal((2000, 3)) @ root.T
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi  # some are now near −π
    claimed = jnp.broadcast_to(jnp.asarray(root @ root.T, float), (2000, 3, 3))
    found = nees(jnp.asarray(pose, float), jnp.asarray(reference, float), claimed)
    assert np.mean(found) == pytest.approx(3, abs=4 * 0.055)
    assert np.mean(np.asarray(found) < 7.815) == pytest.approx(0.95, abs=0.02)
    half = nees(jnp.asarray(pose, float), jnp.asarray(reference, float), claimed / 4)
    np.testing.assert_allclose(half, 4 * found, rtol=1e-3)


def test_nees_stays_finite_where_nothing_is_known():
    claimed = jnp.diag(jnp.array([100.0, 1e-6, 1e-6]))
    found = nees(POSE + jnp.array([5.0, 1e-3, 0.0]), POSE, claimed)
    assert float(found) == pytest.approx(1.25, rel=0.01)
