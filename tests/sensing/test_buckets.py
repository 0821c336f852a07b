"""Rays that say nothing change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.information import covariance
from fsmsm_jax.sensing import Scan, panorama
from fsmsm_jax.sensing.buckets import (
    bucket,
    filled,
    padded,
    padded_rays,
    power_of_two,
    stacked,
)
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE, l_room

# Rays and field of view [°]: LMS, one that reads one direction twice, URG-04LX, UTM-30LX.
# Those of 180, 360 and 720 rays share the buckets of their neighbours, or are like them.
SENSORS = {181: 180, 361: 360, 682: 239.8, 1081: 270}
POSE = np.array([*CENTRE + [0.5, 0.25], 0.4])


def reading(rays, seed=0):
    """A dirty scan of a room whose walls stand some centimetres beside the map's."""
    rng = np.random.default_rng(seed)
    bearings = np.deg2rad(SENSORS.get(rays, 300)) * (np.arange(rays) / (rays - 1) - 0.5)
    walls = np.asarray(l_room().start), np.asarray(l_room().end)
    ranges = cast_walls(*walls, POSE[:2], POSE[2] + bearings, 8.0)
    ranges = ranges + rng.normal(0, 0.01, rays) + 0.03 * np.sin(6 * bearings)
    ranges[rng.random(rays) < 0.05] = np.nan
    ranges[rng.random(rays) < 0.05] = np.inf
    return Scan.from_bearings(ranges, bearings, 0.1, 8.0)


@pytest.mark.parametrize("rays", [7, 180, 361, 1081])
def test_what_is_added_says_nothing(rays):
    scan = reading(rays)
    longer = padded(scan)
    assert longer.ranges.shape == (bucket(rays),) != (rays,)
    for name in ("ranges", "bearings", "valid", "echo"):
        was, now = getattr(scan, name), getattr(longer, name)
        assert isinstance(now, np.ndarray)
        assert now.dtype == was.dtype
        np.testing.assert_array_equal(now[:rays], was)
    assert not longer.valid[rays:].any()
    assert not longer.echo[rays:].any()
    assert (longer.ranges[rays:] == 8.0).all()
    assert (longer.bearings[rays:] == scan.bearings[-1]).all()
    assert padded(longer) is longer


def test_batches_are_padded_as_their_scans_are():
    scans = [reading(181, seed) for seed in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scans)
    expected = stacked(scans)  # each padded alone
    jax.tree.map(np.testing.assert_array_equal, padded(batch), expected)
    assert expected.ranges.shape == (3, 192)
    together = stacked([reading(181), reading(361)])
    assert together.ranges.shape == (2, 384)
    np.testing.assert_array_equal(together.valid[0, :181], scans[0].valid)
    assert not together.valid[0, 181:].any()


def test_a_scan_that_is_too_long_is_refused():
    with pytest.raises(ValueError, match="181 rays does not fit in 180"):
        padded(reading(181), 180)


def test_batches_are_filled_with_their_last():
    batch = {"a": np.arange(3.0), "b": np.arange(6).reshape(3, 2)}
    full = filled(batch, power_of_two(3))
    np.testing.assert_array_equal(full["a"], [0, 1, 2, 2])
    np.testing.assert_array_equal(full["b"], [[0, 1], [2, 3], [4, 5], [4, 5]])
    assert filled(full, 4) is full


def test_values_by_ray_keep_their_last():
    np.testing.assert_array_equal(
        padded_rays(np.array([-1.0, 0.5]), 4), [-1, 0.5, 0.5, 0.5]
    )
    assert padded_rays(np.zeros((3, 181)), 192).shape == (3, 192)


@pytest.mark.parametrize("x64", [False, True])
def test_precision_is_kept(x64):
    with jax.enable_x64(x64):
        scan = reading(181)
        assert padded(scan).ranges.dtype == scan.ranges.dtype
        assert stacked([scan]).bearings.dtype == scan.bearings.dtype


@jax.jit
def views(scan):
    return scan.thin(90), panorama(scan, 120)


@pytest.mark.parametrize("rays", SENSORS)
def test_views_of_a_scan_are_the_same(rays):
    scan = reading(rays)
    expected, found = views(scan), views(padded(scan))
    assert 0.3 < expected[1].valid.mean()
    # Angles are computed in other lanes, that may round otherwise.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    jax.tree.map(close, found, expected)


@jax.jit
def estimate(world, scan, start):
    pose, thickness = fit_ranges(world, scan, start, 6)
    return pose, covariance(world, scan, pose, thickness)


def test_poses_are_the_same():
    scan, start = reading(361), jnp.asarray(POSE + [0.05, -0.04, 0.03], float)
    (pose, spread), (its_pose, its_spread) = (
        estimate(l_room(), s, start) for s in (scan, padded(scan))
    )
    assert np.abs(np.asarray(pose) - POSE).max() < 0.05
    np.testing.assert_allclose(its_pose, pose, atol=1e-5)
    # Neighbours are counted in a circle, in which the last ray now is another one, and
    # shared errors in runs of rays, which now begin elsewhere.
    scale = np.sqrt(np.diagonal(spread))
    scale = scale[:, None] * scale
    np.testing.assert_allclose(its_spread / scale, spread / scale, atol=0.02)
