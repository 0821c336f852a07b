"""Closed worlds against end points joined up by hand and seen again by an oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.evaluation import close_half_scans, simulated_half_scans
from fsmsm_jax.world import PolygonMap, buildings
from tests.oracles.raycast import cast_walls

POSES = np.array([[12.5, -7.25, 0.7], [-30.0, 4.0, -2.9], [3.0, 80.0, 3.1]])


def half_scans(rays, seed=0):
    """Three scans of jagged half rooms with one reading of no echo."""
    ranges = np.random.default_rng(seed).uniform(1, 8, (3, rays))
    ranges[1, rays // 3] = 81.91
    return ranges


def closed_by_hand(ranges, pose, vertices):
    """Project, close behind, cast again: a world, one step after the other."""
    rays = len(ranges)
    spacing = np.pi / (rays - 1) if rays % 2 else np.pi / rays
    angles = [-np.pi / 2 + spacing * n for n in range(rays)]
    ranges = list(ranges)
    smallest = min(ranges)
    while angles[-1] + spacing < 3 * np.pi / 2 - 1e-9:
        angles.append(angles[-1] + spacing)
        ranges.append(smallest)
    headings = pose[2] + np.array(angles)
    points = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    points = pose[:2] + np.array(ranges)[:, None] * points
    again = pose[2] - np.pi + 2 * np.pi * np.arange(vertices) / vertices
    seen = cast_walls(points, np.roll(points, -1, axis=0), pose[:2], again, 1e3)
    return pose[:2] + seen[:, None] * np.stack([np.cos(again), np.sin(again)], axis=-1)


@pytest.mark.parametrize("rays", [90, 180, 181, 360, 361])
@pytest.mark.parametrize("vertices", [360, 77])
def test_worlds_are_those_made_by_hand(rays, vertices):
    ranges = half_scans(rays)
    worlds = close_half_scans(ranges, POSES, vertices)
    for outline, scan, pose in zip(worlds.outlines, ranges, POSES, strict=True):
        np.testing.assert_allclose(
            outline, closed_by_hand(scan, pose, vertices), atol=1e-9
        )


def test_worlds_are_counter_clockwise_around_their_pose():
    worlds = close_half_scans(half_scans(181), POSES)
    assert worlds.outlines.shape == (3, 360, 2)
    for outline, pose in zip(worlds.outlines, POSES, strict=True):
        x, y = (outline - pose[:2]).T
        x1, y1 = np.roll(x, -1), np.roll(y, -1)
        assert np.all(x * y1 - y * x1 > 0)  # every wall passes from right to left
        assert bool(PolygonMap.from_outlines(outline).contains(jnp.asarray(pose[:2])))
        turns = np.sum(np.arctan2(x * y1 - y * x1, x * x1 + y * y1))
        assert turns == pytest.approx(2 * np.pi)


def test_what_lies_behind_is_the_smallest_range():
    ranges = half_scans(361)
    away = np.linalg.norm(close_half_scans(ranges).outlines, axis=-1)
    behind = np.r_[0:90, 271:360]  # −180°..−91° and 91°..179°
    np.testing.assert_allclose(
        away[:, behind], ranges.min(axis=1)[:, None] + 0 * behind
    )
    np.testing.assert_allclose(away[:, 90:271], ranges[:, ::2])
    assert away.max() == pytest.approx(81.91)  # no echo is a range like any other


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_scans_that_cannot_be_closed_are_dropped_and_counted(bad):
    ranges = half_scans(180)
    whole = close_half_scans(ranges, POSES)
    ranges[1, 7] = bad
    worlds = close_half_scans(ranges, POSES)
    assert worlds.dropped == 1
    assert worlds.kept.tolist() == [0, 2]
    np.testing.assert_array_equal(worlds.outlines, whole.outlines[[0, 2]])
    np.testing.assert_array_equal(worlds.poses, POSES[[0, 2]])
    nothing = close_half_scans(np.full((2, 180), bad))
    assert nothing.dropped == 2
    assert nothing.outlines.shape == (0, 360, 2)


def test_too_few_rays():
    with pytest.raises(ValueError, match="at least 3 rays"):
        close_half_scans(np.ones((4, 2)))


def test_simulated_scans_are_what_stands_around():
    world = buildings.office(seed=2, width=14.0, height=9.0)
    take = lambda seed, noise=0.0: simulated_half_scans(
        jax.random.key(seed), world, 12, rays=91, noise=noise
    )
    ranges, poses = take(1)
    assert ranges.shape == (12, 91)
    assert np.all(np.asarray(world.distance_at(poses[:, :2])) > 0.2)
    a = np.linspace(-np.pi / 2, np.pi / 2, 91)
    headings = np.asarray(poses)[:, 2:] + a
    ends = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    ends = np.asarray(poses)[:, None, :2] + np.asarray(ranges)[..., None] * ends
    echo = np.asarray(ranges) < 30
    assert np.mean(np.asarray(world.distance_at(jnp.asarray(ends)))[echo] < 0.1) > 0.97
    again, _ = take(1)
    np.testing.assert_array_equal(ranges, again)
    other, _ = take(2)
    assert not np.allclose(ranges, other)
    off = np.asarray(take(1, noise=0.02)[0] - ranges)[echo]
    assert np.std(off) == pytest.approx(0.02, rel=0.1)
    worlds = close_half_scans(ranges, poses)
    assert worlds.outlines.shape == (12, 360, 2)
    assert worlds.dropped == 0


def test_simulated_scans_name_what_is_wrong():
    world = buildings.office(seed=2, width=14.0, height=9.0)
    with pytest.raises(ValueError, match="odd"):
        simulated_half_scans(jax.random.key(0), world, 2, rays=180)


@pytest.mark.parametrize(
    "name", ["aces", "freiburg_079", "intel", "mit_csail", "mit_killian", "censi"]
)
def test_recordings_of_the_thesis_make_worlds(data, name):
    file = "censi.npz" if name == "censi" else "environments.npz"
    with np.load(data / "thesis" / file) as arrays:
        ranges = arrays["ranges" if name == "censi" else f"{name}_ranges"]
    worlds = close_half_scans(ranges)
    assert worlds.dropped == 0
    assert worlds.outlines.shape == (len(ranges), 360, 2)
    away = np.linalg.norm(worlds.outlines, axis=-1)
    np.testing.assert_allclose(away.min(axis=1), ranges.min(axis=1), rtol=1e-6)
    assert np.all(away.max(axis=1) <= ranges.max(axis=1) * (1 + 1e-6))
