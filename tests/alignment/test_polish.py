"""Descent and polish against truth and physics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.fit import descend_end_points, polish_ranges
from fsmsm_jax.sensing import Lidar
from tests.alignment.simulated import (
    NOISE,
    POSE,
    SENSOR,
    assert_same,
    cast,
    errors,
    few_rays,
    in_double,
    measure,
    office_poses,
    perturbed,
    room_poses,
    small_office,
    walls,
)
from tests.oracles.localisation import range_jacobian
from tests.worlds import l_room, rasterised_room, square_room

DESCENT = jnp.array([0.5, 0.4, 0.3, 0.25, 0.2, 0.2])
POLISH = jnp.array([0.5, 0.3, 0.2, 0.2, 0.1, 0.1])
DRAWS = 250

descend = jax.jit(descend_end_points)
polish = jax.jit(polish_ranges)


@jax.jit
def settle(world, scans, starts):
    """Poses and thicknesses of many polishes."""
    one = lambda args: polish_ranges(world, *args, POLISH)
    return jax.lax.map(one, (scans, starts))


@jax.jit
def fall(world, scans, starts):
    one = lambda args: descend_end_points(world, *args, DESCENT)
    return jax.lax.map(one, (scans, starts))


@pytest.fixture(scope="module")
def places():
    """Worlds and 24 poses in each."""
    office = small_office()
    return {
        "polygon": (l_room(), room_poses(24)),
        "office": (office, office_poses(office, 24)),
    }


@pytest.mark.parametrize(
    ("outliers", "metres", "degrees"), [(0.0, 0.4, 10), (0.3, 0.3, 5)]
)
@pytest.mark.parametrize("kind", ["polygon", "office"])
def test_end_points_pull_a_rough_guess_onto_the_walls(
    places, kind, outliers, metres, degrees
):
    """From between the nodes of a lattice to where polish takes over.

    Nodes 0.4 m and headings 4° apart leave 0.28 m and some degrees. Polish needs a
    tenth of a metre and a few degrees.
    """
    world, true = places[kind]
    sensor = Lidar.create(180, noise=NOISE, outliers=outliers)
    scans = measure(world, sensor, true, jax.random.key(1))
    start = perturbed(true, metres, np.deg2rad(degrees))
    away, turned = errors(fall(world, scans, start), true)
    assert np.mean((away < 0.1) & (turned < np.deg2rad(3))) >= 0.9


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("kind", ["polygon", "office"])
def test_polish_finds_the_pose_that_the_ranges_know(places, kind, outliers):
    """Of 180 rays of 1 cm each, a handful would fix the pose to a centimetre."""
    world, true = places[kind]
    sensor = Lidar.create(180, noise=NOISE, outliers=outliers)
    scans = measure(world, sensor, true, jax.random.key(1))
    found, _ = settle(world, scans, perturbed(true, 0.1, np.deg2rad(3)))
    away, turned = errors(found, true)
    right = (away < NOISE) & (turned < np.deg2rad(0.5))
    assert right.mean() >= 0.9
    assert np.median(away) < NOISE / 3


def test_descent_then_polish_is_exact_without_noise():
    """In float32, a coordinate of 10 m is known to a micrometre: 2⁻²³ × 10 m."""
    world = l_room()
    scan = measure(world, Lidar.create(360, noise=0.0), POSE[None], jax.random.key(0))
    scan = jax.tree.map(lambda a: a[0], scan)
    guess = descend(world, scan, POSE + jnp.array([0.3, -0.2, 0.15]), DESCENT)
    found, thickness = polish(world, scan, guess, jnp.full(20, 0.1))
    away, turned = errors(found, POSE)
    assert away < 1e-5
    assert turned < 1e-5
    assert abs(float(thickness)) < 1e-5


@pytest.mark.parametrize("kind", ["square", "L", "grid", "slanted grid"])
def test_polish_is_as_precise_as_physics_allows(kind):
    """eᵀ C⁻¹ e averages 3 for an estimator that attains the Cramér–Rao bound C.

    The mean of n such squares has standard error √(6/n). No unbiased estimator does
    better; 1.3 × the bound is what we ask of localisation.
    """
    if kind in ("square", "L"):
        world = twin = square_room() if kind == "square" else l_room()
        pose = POSE
    else:
        world, twin = rasterised_room(0.0 if kind == "grid" else 0.3)
        middle = twin.start.mean(axis=0) + jnp.array([0.7, -0.4])
        pose = jnp.append(middle, 0.6)
    true = jnp.tile(pose, (DRAWS, 1))
    scans = measure(world, SENSOR, true, jax.random.key(0))
    found, _ = settle(world, scans, perturbed(true, 0.07, 0.05))
    error = np.asarray(found - true, float)
    bearings = np.asarray(SENSOR.bearings, float)
    J = range_jacobian(*walls(twin), np.asarray(pose, float), bearings) / NOISE
    bound = np.linalg.inv(J.T @ J)[:3, :3]
    mean = np.einsum("ni,ij,nj->n", error, np.linalg.inv(bound), error).mean()
    slack = 4 * np.sqrt(6 / DRAWS)
    assert 3 - slack < mean < 3 * 1.3**2 + slack
    bias = np.abs(error.mean(axis=0)) / np.sqrt(np.diag(bound) / DRAWS)
    assert (bias < 4 * 1.3).all()


def test_thick_walls_are_measured_and_do_not_push_the_pose():
    """Every wall one cell thicker on each side, seen by a sensor that looks ahead.

    Ignored, the cell would push the pose back by itself; a quarter of that is left to
    corners, which grow by more than a cell along a slanted ray.
    """
    world, drawn, cell = small_office(), small_office(thicken=True), 0.05
    true = office_poses(world, 24)
    sensor = Lidar.create(180, np.pi, noise=NOISE)
    scans = measure(world, sensor, true, jax.random.key(2))
    start = perturbed(true, 0.05, 0.03)
    found, thickness = settle(drawn, scans, start)
    thickness = np.asarray(thickness, float)
    assert abs(np.median(thickness) - cell) < 0.2 * cell
    assert np.mean(np.abs(thickness - cell) < 0.4 * cell) >= 0.9
    ahead = jnp.stack([jnp.cos(true[:, 2]), jnp.sin(true[:, 2])], axis=-1)
    pushed = np.asarray(jnp.sum((found - true)[:, :2] * ahead, axis=-1), float)
    assert abs(np.mean(pushed)) < cell / 10
    assert np.median(errors(found, true)[0]) < cell / 4
    _, none = settle(world, scans, start)
    assert np.median(np.abs(none)) < cell / 10


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_few_rays_give_no_nan(count):
    world, scan, start = l_room(), few_rays(l_room(), count), POSE + 0.03
    assert jnp.isfinite(descend(world, scan, start, DESCENT)).all()
    found, thickness = polish(world, scan, start, POLISH)
    assert jnp.isfinite(found).all()
    assert jnp.isfinite(thickness)
    if count == 0:
        np.testing.assert_allclose(found, start, atol=1e-6)  # wrapping rounds


def test_what_leaves_is_wrapped():
    world = l_room()
    pose = POSE.at[2].set(np.pi - 0.01)
    scan = SENSOR.measure(jax.random.key(0), cast(world, pose, SENSOR.bearings))
    for start in (pose.at[2].add(0.05), pose.at[2].add(-0.05)):
        for found in (descend(world, scan, start, DESCENT),
                      polish(world, scan, start, POLISH)[0]):  # fmt: skip
            assert -np.pi <= found[2] < np.pi
            assert errors(found, pose)[1] < np.deg2rad(0.5)


@pytest.fixture(scope="module")
def batch():
    true = room_poses(5)
    scans = measure(l_room(), SENSOR, true, jax.random.key(3))
    return l_room(), scans, perturbed(true, 0.1, 0.05)


def both(world, scan, start, scales):
    """All of the module at once, to compile once."""
    down = descend_end_points(world, scan, start, scales)
    return down, *polish_ranges(world, scan, start, scales)


def test_jit_and_vmap_change_nothing(batch):
    world, scans, starts = batch
    jitted, close = jax.jit(both), {"rtol": 1e-4, "atol": 5e-5}
    many = jax.jit(jax.vmap(both, (None, 0, 0, None)))(world, scans, starts, POLISH)
    for i in range(len(starts)):
        scan, start = jax.tree.map(lambda a, i=i: a[i], (scans, starts))
        one = jitted(world, scan, start, POLISH)
        assert_same([a[i] for a in many], one, **close)
        if i == 0:
            assert_same(both(world, scan, start, POLISH), one, **close)


def test_double_precision_is_kept_and_agrees(batch):
    world, scans, starts = batch
    scan, start = jax.tree.map(lambda a: a[0], (scans, starts))
    single = polish(world, scan, start, POLISH)[0]
    given = jax.tree.map(np.asarray, (world, scan, start, POLISH))
    with jax.enable_x64(True):
        found = jax.jit(both)(*in_double(given))
        for value in found:
            assert value.dtype == jnp.float64
            assert np.isfinite(value).all()
        pose = np.asarray(found[1])
    np.testing.assert_allclose(pose, single, atol=5e-5)
