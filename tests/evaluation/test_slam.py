import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from fsmsm_jax.evaluation.slam import (
    chi2_bounds,
    consistency,
    map_error,
    moved,
    onto,
    way_error,
)

RNG = np.random.default_rng(5)
PLACES = RNG.normal(size=(40, 2)) * [20, 5] + [300, -70]


def squares(pose, points, reference):
    return np.sum((moved(np.asarray(pose), points) - reference) ** 2)


def test_rigid_motions_are_found_and_undone():
    pose = np.array([-30.0, 12.0, 2.9])
    found = onto(PLACES, moved(pose, PLACES))
    # Float64 at hundreds of metres.
    np.testing.assert_allclose(found, pose, atol=1e-10)


def test_no_motion_does_better():
    noisy = moved(np.array([5.0, 3.0, -2.0]), PLACES) + RNG.normal(size=PLACES.shape)
    best = onto(PLACES, noisy)
    searched = minimize(
        squares,
        best + [0.5, -0.5, 0.01],
        (PLACES, noisy),
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-9, "maxiter": 4000, "maxfev": 4000},
    )
    assert squares(best, PLACES, noisy) <= searched.fun + 1e-6  # of about 80
    np.testing.assert_allclose(best[2], searched.x[2], atol=1e-5)


def test_many_runs_are_as_many_single_ones():
    ways = np.stack([PLACES + RNG.normal(size=PLACES.shape) for _ in range(3)])
    poses = np.concatenate([ways, np.zeros((3, 40, 1))], axis=-1)
    times = np.cumsum(RNG.uniform(0.0, 1.0, 40))
    fixes = np.column_stack(
        [RNG.uniform(times[0], times[-1], 9), RNG.normal(size=(9, 2))]
    )
    batch = way_error(times, poses, fixes)
    for n, one in enumerate(poses):
        alone = way_error(times, one, fixes)
        for ours, theirs in zip(batch, alone, strict=True):
            np.testing.assert_allclose(ours[n], theirs, rtol=1e-12)
        # NumPy's interpolation as the oracle.
        there = [np.interp(fixes[:, 0], times, one[:, i]) for i in (0, 1)]
        apart = np.hypot(*(np.array(there) - fixes[:, 1:].T))
        np.testing.assert_allclose(alone.distance, apart, rtol=1e-9)
        np.testing.assert_allclose(alone.rms, np.sqrt(np.mean(apart**2)), rtol=1e-9)


def test_a_gauge_is_no_error_of_the_way():
    """Nor of the map, which turns with it."""
    truth = np.column_stack([np.arange(40.0), PLACES])
    gauge = np.array([0.7, -0.4, 0.03])
    turned = moved(onto_inverse(gauge), PLACES)
    poses = np.column_stack([turned, np.zeros(40)])
    error = way_error(truth[:, 0], jnp.asarray(poses), truth)
    assert error.rms > 5  # 0.03 rad at 300 m
    # JAX's float32 at 300 m.
    assert error.aligned_rms < 1e-4
    np.testing.assert_allclose(error.gauge[2], gauge[2], atol=1e-6)
    trees = PLACES[:7] + 3.0
    seen = moved(onto_inverse(gauge), trees)
    assert map_error(seen, trees).missing == 7
    assert map_error(moved(error.gauge, seen), trees).rms < 1e-4


def onto_inverse(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[:2]
    return np.array([-c * x - s * y, s * x - c * y, -pose[2]])


def test_fixes_outside_and_times_that_stand_still():
    poses = np.array([[5.0, 1.0, 0.0], [6.0, 1.0, 0.0], [8.0, 1.0, 0.0]])
    times = np.array([3.0, 3.0, 5.0])
    fixes = np.array([[1.0, 0, 0], [4.0, 7.0, 1.0], [5.0, 8.0, 3.0], [9.0, 0, 0]])
    np.testing.assert_allclose(way_error(times, poses, fixes).distance, [0.0, 2.0])
    one = way_error(np.array([3.0]), poses[:1], np.array([[3.0, 5.0, 3.0]]))
    np.testing.assert_allclose(one.distance, [2.0])
    with pytest.raises(ValueError, match="no fix between"):
        way_error(times, poses, fixes[[0, 3]])
    with pytest.raises(ValueError, match="a time for each pose"):
        way_error(times[:2], poses, fixes)


def test_map_pairs_are_the_best_of_all():
    """Every assignment of five to six was tried."""
    found = RNG.uniform(50, 53, (5, 2))
    true = RNG.uniform(50, 53, (6, 2))
    apart = np.linalg.norm(found[:, None] - true[None], axis=-1)
    least = min(
        sum(min(apart[i, j], 0.8) for i, j in enumerate(order))
        for order in itertools.permutations(range(6), 5)
    )
    error = map_error(found, true, within=0.8)
    pairs = error.distance.size
    np.testing.assert_allclose(error.distance.sum() + 0.8 * (5 - pairs), least)
    assert (error.missing, error.extra) == (6 - pairs, 5 - pairs)
    nothing = map_error(np.zeros((0, 2)), true)
    assert (nothing.missing, nothing.extra) == (6, 0)
    assert np.isnan(nothing.rms)


def draws(runs, steps, scale=1.0):
    """Errors whose covariances are true up to a scale; metres and radians."""
    root = np.array([[0.5, 0, 0], [0.2, 0.3, 0], [0.004, -0.002, 0.001]])
    off = RNG.normal(size=(runs, steps, 3)) @ root.T
    return off, np.broadcast_to(scale * root @ root.T, (runs, steps, 3, 3))


def test_honest_filters_are_inside_and_sure_ones_are_not():
    runs, steps = 50, 400
    honest = consistency(*draws(runs, steps))
    # 400 independent steps: a standard error of √(.95 · .05 / 400) = 0.011.
    assert honest.inside == pytest.approx(0.95, abs=0.04)
    # A χ² of 3 · 50 · 400: √(2 · 3 / 20 000) = 0.017.
    assert honest.mean == pytest.approx(3.0, abs=0.06)
    off, covariance = draws(runs, steps, 0.5)
    sure = consistency(off[..., :2], covariance[..., :2, :2])
    assert sure.inside < 0.1
    assert sure.mean == pytest.approx(4.0, abs=0.1)
    assert (sure.low, sure.high) == chi2_bounds(50, 2)


def test_singular_claims_are_unknown():
    off, covariance = draws(4, 3)
    covariance = covariance.copy()
    covariance[2, 0] = 0.0  # the start, which is known
    covariance[1, 1, :2, :2] = 0.01 * np.ones((2, 2))  # along a line only
    covariance[1, 1, 2, :2] = covariance[1, 1, :2, 2] = 0.0
    some = consistency(off, covariance)
    assert np.isnan(some.average).tolist() == [True, True, False]
    assert some.mean == some.average[2]
