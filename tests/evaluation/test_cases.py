"""Cases: what was promised of the poses, the scans and the noise; the published ones."""

import csv
import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from fsmsm_jax import geometry
from fsmsm_jax.evaluation import (
    close_half_scans,
    draw_cases,
    noisy,
    published_cases,
    scan_to_scan,
)
from fsmsm_jax.evaluation.cases import _cast, as_worlds, noisy_ranges
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE

COUNT = 24


@pytest.fixture(scope="module")
def worlds():
    """Jagged rooms of 1 to 6 m with smooth stretches, away from the origin."""
    rng = np.random.default_rng(5)
    knots = rng.uniform(1.2, 6, (COUNT, 13))
    ranges = np.repeat(knots, 14, axis=1)[:, :181]
    ranges += 0.3 * np.sin(np.linspace(0, 9, 181))
    poses = np.column_stack(
        [CENTRE + rng.uniform(-9, 9, (COUNT, 2)), rng.uniform(-3, 3, COUNT)]
    )
    return close_half_scans(ranges, poses)


@pytest.fixture(scope="module")
def cases(worlds):
    return draw_cases(jax.random.key(3), worlds.outlines, worlds.poses)


def square(side, copies):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2 + CENTRE
    return np.broadcast_to(corners, (copies, 4, 2)), np.tile(
        [*CENTRE, 0.3], (copies, 1)
    )


def to_walls(point, outline):
    """Distance to the nearest wall, one wall at a time."""
    away = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        t = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        away.append(np.linalg.norm(point - a - t * (b - a)))
    return min(away)


def test_true_poses_are_clear_of_everything(cases, worlds):
    a = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    for outline, pose, ranges in zip(
        worlds.outlines, np.asarray(cases.true, float), cases.ranges, strict=True
    ):
        assert to_walls(pose[:2], outline) > 0.4999
        end = np.roll(outline, -1, axis=0)
        exact = cast_walls(outline, end, pose[:2], pose[2] + a, 1e3)
        assert exact.min() > 0.4999
        # A ray that passes a corner within rounding may see past it.
        assert np.quantile(np.abs(exact - ranges), 0.99) < 1e-4
    assert np.all(np.abs(cases.true[:, 2]) <= np.pi)


def test_initial_poses_are_near_inside_and_clear(cases, worlds):
    away = cases.initial - cases.true
    assert np.abs(away[:, :2]).max() <= 0.2 + 1e-5
    assert np.abs(geometry.wrap(away[:, 2])).max() <= math.pi / 4 + 1e-5
    inside = jax.vmap(lambda w, p: w.contains(p[:2]))
    assert bool(inside(as_worlds(cases.outlines), cases.initial).all())
    xy = np.asarray(cases.initial)[:, None, :2]
    assert np.linalg.norm(xy - worlds.outlines, axis=-1).min() > 0.2499


def test_positions_are_uniform_where_they_may_be():
    outlines, poses = square(6.0, 600)
    cases = draw_cases(jax.random.key(0), outlines, poses, 0.1, 0.3)
    xy = np.asarray(cases.true[:, :2]) - CENTRE
    away = cases.initial - cases.true
    away = away.at[:, 2].set(geometry.wrap(away[:, 2]))
    for sample, width in (
        (xy[:, 0], 2.5),
        (xy[:, 1], 2.5),
        (cases.true[:, 2], np.pi),
        (away[:, 0], 0.1),
        (away[:, 1], 0.1),
        (away[:, 2], 0.3),
    ):
        fits = stats.kstest(np.asarray(sample), stats.uniform(-width, 2 * width).cdf)
        assert fits.pvalue > 1e-3


def test_in_a_tiny_world_the_pose_of_the_recording_serves():
    outlines, poses = square(0.4, 3)
    cases = draw_cases(jax.random.key(0), outlines, poses)
    np.testing.assert_allclose(cases.true, poses, rtol=1e-6)
    assert np.abs(np.asarray(cases.initial)[:, :2] - CENTRE).max() < 0.2  # inside
    assert not np.allclose(cases.initial, cases.true)


def test_same_key_same_cases(cases, worlds):
    again = draw_cases(jax.random.key(3), worlds.outlines, worlds.poses)
    jax.tree.map(np.testing.assert_array_equal, again, cases)
    other = draw_cases(jax.random.key(4), worlds.outlines, worlds.poses)
    for field in ("true", "initial", "ranges", "z_range", "z_map"):
        assert not np.allclose(getattr(cases, field), getattr(other, field))


def test_noise_has_its_size_and_is_shared_between_levels(cases):
    exact_worlds, exact = noisy(cases)
    np.testing.assert_array_equal(exact, cases.ranges)
    np.testing.assert_array_equal(exact_worlds.start, cases.outlines)
    np.testing.assert_array_equal(exact_worlds.end[:, :-1], cases.outlines[:, 1:])
    np.testing.assert_array_equal(exact_worlds.end[:, -1], cases.outlines[:, 0])
    world, ranges = noisy(cases, 0.02, 0.05)
    added, moved = ranges - exact, world.start - exact_worlds.start
    np.testing.assert_array_equal(world.end[:, :-1], world.start[:, 1:])  # closed
    for noise, sigma in ((added, 0.02), (moved[..., 0], 0.05), (moved[..., 1], 0.05)):
        assert np.std(noise) == pytest.approx(sigma, rel=0.03)
        assert abs(np.mean(noise)) < 4 * sigma / math.sqrt(noise.size)
    pairs = np.corrcoef([np.ravel(added), *np.reshape(moved, (-1, 2)).T])
    assert np.abs(pairs - np.eye(3)).max() < 4 / math.sqrt(added.size)
    _, louder = noisy(cases, 0.04, 0.0)
    np.testing.assert_allclose(louder - exact, 2 * added, atol=1e-5)


def test_negative_ranges_are_drawn_again():
    sigma, r = 0.2, 0.15
    z = jax.random.normal(jax.random.key(1), (20_000,))
    ranges = np.asarray(noisy_ranges(jnp.full(20_000, r), z, sigma))
    plain = r + sigma * np.asarray(z)
    assert np.mean(plain < 0) > 0.2
    np.testing.assert_allclose(ranges[plain >= 0], plain[plain >= 0], atol=1e-6)
    assert ranges.min() >= -1e-7
    truncated = stats.truncnorm(-r / sigma, np.inf, r, sigma)
    assert stats.kstest(ranges, truncated.cdf).pvalue > 1e-3
    fresh = ranges[plain < 0]
    assert stats.kstest(fresh, truncated.cdf).pvalue > 1e-3


def test_scan_to_scan_is_the_same_question_seen_from_the_initial_pose(cases):
    pair = scan_to_scan(cases)
    np.testing.assert_array_equal(pair.initial, 0)
    back = jax.vmap(geometry.compose)(cases.initial, pair.true)
    np.testing.assert_allclose(back[:, :2], cases.true[:, :2], atol=1e-5)
    turned = geometry.wrap(back[:, 2] - cases.true[:, 2])
    np.testing.assert_allclose(turned, 0, atol=1e-5)
    on_walls = jax.vmap(geometry.transform_points)(cases.initial, pair.outlines)
    worlds = as_worlds(cases.outlines)
    away = jax.vmap(lambda world, points: world.distance_at(points))(worlds, on_walls)
    assert np.asarray(away).max() < 1e-3
    np.testing.assert_array_equal(pair.ranges, cases.ranges)


def test_scan_to_scan_has_noise_in_both_scans(cases):
    exact, pair = scan_to_scan(cases), scan_to_scan(cases, 0.03)
    length = lambda outlines: np.linalg.norm(outlines, axis=-1)
    off = length(pair.outlines) - length(exact.outlines)
    assert np.std(off) == pytest.approx(0.03, rel=0.03)
    _, real = noisy(pair, 0.03)
    both = np.corrcoef(np.ravel(off), np.ravel(real - cases.ranges))
    assert abs(both[0, 1]) < 4 / math.sqrt(off.size)


# --- The published cases ------------------------------------------------------------


@pytest.fixture(scope="module")
def golden():
    default = Path(__file__).parents[3] / "shared" / "golden"
    folder = Path(os.environ.get("FSMSM_GOLDEN", default))
    file = folder / "fsm_bench_cases.npz"
    if not file.is_file():
        pytest.skip(f"no C++ results at {file}; point FSMSM_GOLDEN at their folder")
    with np.load(file) as arrays:
        arrays = dict(arrays)
    with (folder / "fsm_bench.csv").open() as lines:
        return arrays, [row for row in csv.DictReader(lines) if row["sigma_R"] == "0"]


def test_published_offsets(golden):
    arrays, rows = golden
    with jax.enable_x64(True):
        cases = published_cases(arrays)
        away = np.asarray(cases.initial - cases.true)
        turned = np.abs(np.asarray(geometry.wrap(jnp.asarray(away[:, 2]))))
    at = {case: index for index, case in enumerate(arrays["dataset_id"])}
    index = [at[int(row["dataset_id"])] for row in rows]
    assert len(set(index)) == len(cases.true)
    column = lambda name: np.array([float(row[name]) for row in rows])
    offset = np.hypot(*away.T[:2])[index]
    np.testing.assert_allclose(offset, column("init_position_offset_m"), atol=1e-8)
    angle = column("init_orientation_offset_rad")
    np.testing.assert_allclose(turned[index], np.abs(angle), atol=1e-8)


def test_published_scans_seen_again(golden):
    arrays, _ = golden
    with jax.enable_x64(True):
        cases = published_cases({k: v[:100] for k, v in arrays.items()})
        seen = jax.jit(_cast, static_argnums=2)(
            as_worlds(cases.outlines), cases.true, 360
        )
        error = np.abs(np.asarray(seen) / arrays["real_scan"][:100] - 1)
    # Its raycaster takes rays within 1e-4 rad of the vertical for vertical.
    assert np.mean(error > 1e-6) < 1e-3
    assert error.max() < 1e-3


def test_published_noise_is_what_the_program_added(golden):
    arrays, _ = golden
    cases = published_cases(arrays)
    worlds, ranges = noisy(cases, 0.05, 0.05)
    expected = arrays["map_y"] + 0.05 * arrays["z_map_y"]
    np.testing.assert_allclose(worlds.start[..., 1], expected, atol=1e-5)
    expected = arrays["real_scan"] + 0.05 * arrays["z_range"]
    np.testing.assert_allclose(ranges, expected, atol=1e-5)
    worlds, _ = noisy(published_cases(arrays, exact_ranges=True), 0.0, 0.05)
    expected = arrays["map_x"] + 0.05 * arrays["z_map_x_when_sigmaR0"]
    np.testing.assert_allclose(worlds.start[..., 0], expected, atol=1e-5)


def test_published_maps_are_our_closing_of_the_recordings(golden, data):
    arrays, _ = golden
    with np.load(data / "thesis" / "censi.npz") as recorded:
        worlds = close_half_scans(recorded["ranges"], recorded["odom_pose"])
    theirs = np.stack([arrays["map_x"], arrays["map_y"]], axis=-1)
    off = np.abs(worlds.outlines - theirs).max(axis=-1)
    assert np.mean(off > 1e-6) < 1e-4  # the vertical again
    assert off.max() < 1e-3
