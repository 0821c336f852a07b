"""The transform's scores against direct sums on a tiny map."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation import AtlasConfig, build_atlas, correlative
from fsmsm_jax.localisation.atlas import range_phases
from fsmsm_jax.localisation.correlative import rank_poses
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid
from tests.oracles.localisation import best_of_blocks, distance_to_walls, score_map
from tests.worlds import CENTRE, free_poses, l_room, random_cells

HEADINGS = 24
CONFIG = AtlasConfig(spacing=0.5, rays=36, reach=6.0, softness=0.4)
SENSOR = Lidar.create(90, noise=0.01, range_max=12.0)
RULES = (correlative._THROUGH, correlative._THROUGH_WEIGHT, correlative._CLEAR_OF_WALL)
# A score is told in ticks of 2⁻²⁰, and float32 transforms of a thousand numbers err
# by a few roundings of scores up to 1.
EXACT = 2.0**-20 + 8 * 2.0**-23

rank = jax.jit(rank_poses, static_argnums=(2, 3))
cast = jax.jit(raycast)


@pytest.fixture(scope="module")
def atlas():
    return build_atlas(l_room(), CONFIG)


def scan_from(world, pose, seed=0):
    exact = cast(world, pose, SENSOR.bearings, SENSOR.range_max)
    return SENSOR.measure(jax.random.key(seed), exact)


def dirty_scan(seed):
    """Ranges of no room at all, many beyond the map, some echoless, some invalid."""
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 11.0, 90)
    ranges[rng.random(90) < 0.1] = np.inf
    ranges[rng.random(90) < 0.1] = np.nan
    return Scan.from_ranges(ranges, -2.0, 0.05, 0.1, 12.0)


def all_scores(world, allowed, padded_shape, scan):
    """(headings, rows, columns) by direct summation, for a polygon world."""
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    corner = np.minimum(start.min(axis=0), end.min(axis=0))
    row, column = np.indices(allowed.shape)
    nodes = corner + (np.stack([column, row], axis=-1) + 0.5) * CONFIG.spacing
    d = distance_to_walls(start, end, nodes.reshape(-1, 2)).reshape(allowed.shape)
    field = np.exp(-0.5 * (d / CONFIG.softness) ** 2)
    valid, echo = np.asarray(scan.valid), np.asarray(scan.echo)
    ranges = np.where(echo, np.asarray(scan.ranges, float), np.inf)[valid]
    bearings = np.asarray(scan.bearings, float)[valid]
    theta = -np.pi + 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    scores = [
        score_map(field, padded_shape, ranges, bearings, t, CONFIG.spacing,
                  CONFIG.reach, RULES)
        for t in theta
    ]  # fmt: skip
    return corner, theta, np.array(scores)


@pytest.mark.parametrize("kind", ["true", "dirty"])
def test_scores_are_the_sums_they_stand_for(atlas, kind):
    world, allowed = l_room(), np.asarray(atlas.lattice.allowed)
    pose = jnp.asarray([*(CENTRE + [0.6, 0.3]), 1.1], float)
    scan = scan_from(world, pose) if kind == "true" else dirty_scan(0)
    corner, theta, scores = all_scores(world, allowed, atlas.padded_shape, scan)
    listed = best_of_blocks(scores, allowed)
    count = int(np.isfinite(listed).sum())
    poses, _, told = rank(atlas, scan, HEADINGS, count)
    np.testing.assert_allclose(told, listed[:count], atol=EXACT)
    # Each score is that of the very pose beside it.
    column, row = np.rint((np.asarray(poses[:, :2]) - corner) / 0.5 - 0.5).astype(int).T
    k = np.argmin(np.abs(theta[None] - np.asarray(poses[:, 2:])), axis=1)
    np.testing.assert_allclose(np.asarray(poses[:, 2]), theta[k], atol=1e-6)
    assert allowed[row, column].all()
    np.testing.assert_allclose(told, scores[k, row, column], atol=EXACT)


def test_far_end_points_come_round_but_do_not_reach_the_map(atlas):
    """An echo off the map by less than the padding meets nothing, wherever it wraps."""
    rows, columns = atlas.lattice.allowed.shape
    height, width = atlas.padded_shape
    reach = 0.5 * CONFIG.reach / CONFIG.spacing
    assert height >= rows + reach
    assert width >= columns + reach


def test_the_right_place_is_among_the_first(atlas):
    """Right: nearest node or beside it (half a diagonal), and the nearest headings."""
    world, rng = l_room(), np.random.default_rng(1)
    for i in range(12):
        offset = [*rng.uniform([-1.2, -0.5], [3.0, 1.0]), rng.uniform(-np.pi, np.pi)]
        pose = jnp.asarray(np.array([*CENTRE, 0.0]) + offset, float)
        poses, _, _ = rank(atlas, scan_from(world, pose, i), HEADINGS, 32)
        off = np.asarray(poses[:10], float) - np.asarray(pose)
        turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        near = np.hypot(off[:, 0], off[:, 1]) < 1.5 * CONFIG.spacing
        assert (near & (turned < 1.5 * 2 * np.pi / HEADINGS)).any()


def test_of_a_block_only_the_best_is_listed(atlas):
    scan = scan_from(l_room(), jnp.asarray([*CENTRE, 0.4], float))
    poses, _, scores = rank(atlas, scan, HEADINGS, 60)
    lattice = atlas.lattice
    node = (np.asarray(poses[:, :2]) - np.asarray(lattice.frame[:2])) / 0.5 - 0.5
    sector = np.rint((np.asarray(poses[:, 2]) + np.pi) * HEADINGS / (2 * np.pi))
    blocks = np.column_stack([np.rint(node) // 2, sector // 6])
    assert len(np.unique(blocks, axis=0)) == len(blocks)
    assert (np.diff(scores) <= 0).all()
    assert scores[0] <= 1


def test_more_poses_than_there_are_are_not_asked_for(atlas):
    scan = scan_from(l_room(), jnp.asarray([*CENTRE, 0.4], float))
    rows, columns = atlas.lattice.allowed.shape
    blocks = -(-rows // 2) * -(-columns // 2) * HEADINGS // 6
    poses, index, _ = rank(atlas, scan, HEADINGS, 10**6)
    assert len(poses) == len(index) == blocks
    assert (np.asarray(index) < len(atlas.panoramas)).all()


def test_the_index_leads_to_the_panorama_of_the_place(atlas):
    world = l_room()
    scan = scan_from(world, jnp.asarray([*CENTRE, 0.4], float))
    poses, index, _ = rank(atlas, scan, HEADINGS, 32)
    bearings = jnp.linspace(-jnp.pi, jnp.pi, CONFIG.rays, endpoint=False)
    for pose, i in zip(poses, index, strict=True):
        ranges = cast(world, pose.at[2].set(0.0), bearings, CONFIG.range_max)
        kept = np.fft.ifft(atlas.panoramas[i])
        # A ray at a corner of the room may fall to either side of it.
        differs = np.abs(kept - np.asarray(range_phases(ranges))) > 1e-3
        assert differs.sum() <= 1


def test_a_turned_map_is_searched_as_it_lies():
    """Turned by two steps of heading and shifted, the list is turned and shifted."""
    cells = np.pad(random_cells(3, 70, 100), 1, constant_values=100)
    flat = OccupancyGrid.from_cells(cells, 0.05, (3.0, -8.0, 0.0))
    move = jnp.array([10.0, 20.0, 2 * 2 * np.pi / HEADINGS])
    turned = OccupancyGrid.from_cells(cells, 0.05, geometry.compose(move, flat.origin))
    here, there = build_atlas(flat, CONFIG), build_atlas(turned, CONFIG)
    np.testing.assert_array_equal(here.lattice.allowed, there.lattice.allowed)
    pose = jnp.asarray(free_poses(flat, 1, seed=4)[0], float)
    scan = scan_from(flat, pose)
    poses, index, scores = rank(here, scan, HEADINGS, 10)
    moved, moved_index, moved_scores = rank(there, scan, HEADINGS, 10)
    np.testing.assert_allclose(moved_scores, scores, atol=1e-4)
    best = geometry.compose(move, poses[0])
    off = np.asarray(moved, float) - np.asarray(best)
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    # Equal scores may change places, and sectors of headings begin elsewhere.
    same = np.flatnonzero(np.abs(off).max(axis=1) < 1e-3)
    assert len(same) == 1
    assert int(moved_index[same[0]]) == int(index[0])
    assert abs(float(moved_scores[same[0]] - scores[0])) < 1e-4


def test_signature_says_what_is_static():
    assert list(inspect.signature(rank_poses).parameters) == [
        "atlas", "scan", "headings", "count",
    ]  # fmt: skip
