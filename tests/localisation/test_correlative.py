"""The transform's scores against direct sums on small maps, in one tile and in many."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.localisation import AtlasConfig, build_atlas, judge, tiles
from fsmsm_jax.localisation.correlative import Box, rank_poses
from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.localisation.shells import places_left, scan_shells
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid
from tests.oracles.localisation import best_of_boxes, distance_to_walls, score_map
from tests.worlds import CENTRE, free_poses, l_room, random_cells

HEADINGS = 30
CONFIG = AtlasConfig(spacing=0.5, rays=36, reach=6.0, softness=0.4)
SHORT = AtlasConfig(spacing=0.25, rays=36, reach=1.6, softness=0.4)
SENSOR = Lidar.create(90, noise=0.01, range_max=12.0)
RULES = (judge.ON_THE_WAY, judge.IN_THE_WAY, judge.CLEAR_OF_WALL)
BOX, SHORT_BOX = (Box.of(config.spacing, HEADINGS) for config in (CONFIG, SHORT))
# A score is told in ticks of about 2⁻²⁰, and float32 transforms of some thousand numbers err
# by a few roundings of scores up to 1.
EXACT = 2.0**-20 + 8 * 2.0**-23

MOVE = jnp.array([10.0, 20.0, 2 * 2 * np.pi / HEADINGS])

cast = jax.jit(raycast)
echoes = jax.jit(scan_shells, static_argnums=(1, 2))
rank = jax.jit(rank_poses, static_argnums=(2, 3))


def rank_all(atlas, scan):
    """As many poses as there are; the map itself is not looked at."""
    atlas = eqx.tree_at(lambda atlas: atlas.world, atlas, l_room())
    return rank(atlas, scan, HEADINGS, 10**6)


def unruled(atlas):
    """The same atlas with shells that explain everything."""
    full = jnp.full_like(atlas.tiles.shells, 255)
    return eqx.tree_at(lambda atlas: atlas.tiles.shells, atlas, full)


@pytest.fixture(scope="module")
def atlas():
    return build_atlas(l_room(), CONFIG)


@pytest.fixture(scope="module")
def tiled():
    """Of a short reach, in eight tiles that are mostly rim."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "_SIDES", (24,))
        made = build_atlas(l_room(), SHORT)
    assert (made.tiles.side, made.tiles.core) == (24, 8)
    assert made.tiles.allowed.any(axis=(1, 2)).sum() == 8
    return made


@pytest.fixture(scope="module")
def closed_grids():
    """Walls, furniture and an unknown corner; as it lies, and moved and turned."""
    cells = np.pad(random_cells(3, 70, 100), 1, constant_values=100)
    flat = OccupancyGrid.from_cells(cells, 0.05, (3.0, -8.0, 0.0))
    moved = OccupancyGrid.from_cells(cells, 0.05, geometry.compose(MOVE, flat.origin))
    return [(world, build_atlas(world, CONFIG)) for world in (flat, moved)]


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


def lonely_scan():
    """Few echoes at hand, and else nothing: the way of all other rays must be free."""
    ranges = np.full(90, np.inf)
    ranges[::8] = 0.4
    return Scan.from_ranges(ranges, -np.pi, 2 * np.pi / 90, 0.1, 12.0)


SCANS = {
    "true": lambda: scan_from(l_room(), jnp.asarray([*(CENTRE + [0.6, 0.3]), 1.1])),
    "dirty": lambda: dirty_scan(0),
    "lonely": lonely_scan,
}


def all_scores(config, scan):
    """(headings, rows, columns) by direct summation in the L-shaped room, and more.

    Also its lower left corner, the headings, and where one may stand.
    """
    world = l_room()
    _, allowed = lattice_over(world, config.spacing, config.margin)
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    corner = np.minimum(start.min(axis=0), end.min(axis=0))
    row, column = np.indices(allowed.shape)
    nodes = corner + (np.stack([column, row], axis=-1) + 0.5) * config.spacing
    d = distance_to_walls(start, end, nodes.reshape(-1, 2)).reshape(allowed.shape)
    field = np.exp(-0.5 * (d / config.softness) ** 2)
    valid, echo = np.asarray(scan.valid), np.asarray(scan.echo)
    ranges = np.where(echo, np.asarray(scan.ranges, float), np.inf)[valid]
    bearings = np.asarray(scan.bearings, float)[valid]
    theta = -np.pi + 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    scores = [
        score_map(field, ranges, bearings, t, config.spacing, config.reach, RULES)
        for t in theta
    ]
    return np.array(scores), corner, theta, allowed


def index_of(poses, spacing, corner, theta):
    """Heading, row and column of lattice poses, which are to be exactly there."""
    poses = np.asarray(poses, float)
    place = (poses[:, :2] - corner) / spacing - 0.5
    column, row = np.rint(place).astype(int).T
    np.testing.assert_allclose(place, np.rint(place), atol=1e-5)
    k = np.argmin(np.abs(theta[None] - poses[:, 2:]), axis=1)
    np.testing.assert_allclose(poses[:, 2], theta[k], atol=1e-6)
    return k, row, column


def assert_same_as_sums(found, made, scan, left=None, exact=EXACT):
    """The list is that of the sums at the nodes that are left, score by score.

    Sums have no lower bound, since rays without echo have a say in the ways but not in
    the ends. Under −1 only the order counts, and that they are not taken for nothing.
    """
    config, core = made.config, made.tiles.core
    box = Box.of(config.spacing, HEADINGS)
    scores, corner, theta, allowed = all_scores(config, scan)
    left = allowed if left is None else left
    wanted = best_of_boxes(scores, left, core, *box)
    told = np.asarray(found.score, float)
    real = told > -2
    assert real.sum() == len(wanted)
    assert real[: len(wanted)].all()  # the rest comes last
    poses, told = np.asarray(found.poses)[real], told[real]
    likely = wanted > -1
    np.testing.assert_allclose(told[likely], wanted[likely], atol=exact)
    assert (told[~likely] <= -1 + exact).all()
    # Each score is that of the very pose beside it, and none is listed twice.
    k, row, column = index_of(poses, config.spacing, corner, theta)
    assert left[row, column].all()
    its = scores[k, row, column]
    np.testing.assert_allclose(told[likely], its[likely], atol=exact)
    boxes = (
        k // box.headings,
        *(n // core * core + n % core // box.nodes for n in (row, column)),
    )
    assert len({*zip(*boxes, strict=True)}) == len(wanted)
    return wanted


@pytest.mark.parametrize("kind", SCANS)
def test_scores_are_the_sums_they_stand_for(atlas, kind):
    """Also where there are few echoes, and ways through all walls."""
    scan = SCANS[kind]()
    wanted = assert_same_as_sums(rank_all(unruled(atlas), scan), atlas, scan)
    assert (wanted.min() < -2) == (kind == "lonely")


@pytest.mark.parametrize("kind", SCANS)
def test_tiles_say_the_same(tiled, kind):
    """End points beyond a tile's core are seen in its rim, wherever its neighbour is."""
    scan = SCANS[kind]()
    assert_same_as_sums(rank_all(unruled(tiled), scan), tiled, scan)


def test_the_best_of_all_tiles_come_first(tiled):
    """Where only some are listed, they are the beginning of all."""
    scan = SCANS["true"]()
    some, every = rank(tiled, scan, HEADINGS, 40), rank_all(tiled, scan)
    assert len(some.poses) == 40
    np.testing.assert_array_equal(every.score[:40], some.score)
    np.testing.assert_allclose(every.poses[:40], some.poses, atol=1e-5)


def left_by_shells(atlas, scan, shape):
    """Nodes that the shells leave, laid out as the lattice is."""
    core = atlas.tiles.core
    left = np.zeros((shape[0] + core, shape[1] + core), bool)
    seen = echoes(scan, atlas.config.rays, atlas.config.reach)
    kept = np.asarray(places_left(seen, atlas.tiles.shells) & atlas.tiles.allowed)
    for (row, column), tile in zip(np.asarray(atlas.tiles.corner), kept, strict=True):
        left[row : row + core, column : column + core] |= tile
    return left[: shape[0], : shape[1]]


@pytest.mark.parametrize("kind", ["atlas", "tiled"])
def test_what_the_shells_rule_out_is_not_listed(kind, request):
    """Whole tiles, too, where nobody is left."""
    made = request.getfixturevalue(kind)
    scan = SCANS["true"]()
    config = made.config
    _, allowed = lattice_over(l_room(), config.spacing, config.margin)
    left = left_by_shells(made, scan, allowed.shape)
    assert 0 < left.sum() < allowed.sum()
    assert_same_as_sums(rank_all(made, scan), made, scan, left)


@pytest.mark.parametrize("kind", ["true", "lonely"])
def test_nobody_stands_where_none_may(closed_grids, kind):
    """In walls, furniture and the unknown, however many are asked for."""
    world, made = closed_grids[1]
    lattice, allowed = lattice_over(world, CONFIG.spacing, CONFIG.margin)
    assert not allowed.all()
    poses, scores = rank_all(unruled(made), SCANS[kind]())
    real = np.asarray(scores) > -2
    boxes = best_of_boxes(
        np.zeros((HEADINGS, *allowed.shape)), allowed, made.tiles.core, *BOX
    )
    assert real.sum() == len(boxes)
    back = geometry.transform_points(geometry.inverse(lattice.frame), poses[:, :2])
    column, row = np.rint(np.asarray(back)[real] / CONFIG.spacing - 0.5).astype(int).T
    assert allowed[row, column].all()


def test_the_right_place_is_among_the_first(atlas):
    """Right: nearest node or beside it (half a diagonal), and the nearest headings."""
    world, rng = l_room(), np.random.default_rng(1)
    for i in range(12):
        offset = [*rng.uniform([-1.2, -0.5], [3.0, 1.0]), rng.uniform(-np.pi, np.pi)]
        pose = jnp.asarray(np.array([*CENTRE, 0.0]) + offset, float)
        poses, _ = rank_all(atlas, scan_from(world, pose, i))
        off = np.asarray(poses[:10], float) - np.asarray(pose)
        turned = np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        near = np.hypot(off[:, 0], off[:, 1]) < 1.5 * CONFIG.spacing
        assert (near & (turned < 1.5 * 2 * np.pi / HEADINGS)).any()


def test_a_box_is_as_large_as_a_descent_reaches():
    assert Box.of(0.8, 60) == (4, 1)
    assert Box.of(0.4, 90) == (6, 2)
    assert Box.of(2.0, 14) == (1, 1)
    assert Box.of(0.5, 62) == (2, 2)  # 4 does not divide 62
    assert (BOX, SHORT_BOX) == ((2, 2), (2, 3))
    for box in (BOX, SHORT_BOX, Box(24, 16)):  # float32 tells scores up to 2 apart
        assert 2 * box.ticks * box.headings * box.nodes**2 <= 2**24


def test_of_the_poses_in_a_box_only_the_best_is_listed(atlas):
    scan = scan_from(l_room(), jnp.asarray([*CENTRE, 0.4], float))
    poses, scores = (a[:60] for a in rank_all(atlas, scan))
    node = (np.asarray(poses[:, :2]) - np.asarray(atlas.lattice.frame[:2])) / 0.5 - 0.5
    heading = np.rint((np.asarray(poses[:, 2]) + np.pi) * HEADINGS / (2 * np.pi))
    boxes = np.column_stack([np.rint(node) // 2, heading % HEADINGS // 2])
    assert len(np.unique(boxes, axis=0)) == len(boxes) == 60
    assert (np.diff(scores) <= 0).all()
    assert scores[0] <= 1


def test_more_poses_than_there_are_come_last_and_score_as_none(atlas):
    scan = scan_from(l_room(), jnp.asarray([*CENTRE, 0.4], float))
    poses, scores = rank_all(atlas, scan)
    boxes = BOX.per_core(HEADINGS, atlas.tiles.core)
    assert len(poses) == len(scores) == len(atlas.tiles.allowed) * np.prod(boxes)
    none = np.asarray(scores) == -2
    assert none[np.argmax(none) :].all()
    assert (np.asarray(scores)[~none] > -1.5).all()
    assert np.isfinite(poses).all()


def test_a_turned_map_is_searched_as_it_lies(closed_grids):
    """Turned by two steps of heading and shifted, the list is turned and shifted.

    Without the shells: many ranges from the lattice to a grid's walls are whole numbers
    of them, and rounding decides in which they are.
    """
    (flat, here), (_, there) = closed_grids
    np.testing.assert_array_equal(here.tiles.allowed, there.tiles.allowed)
    pose = jnp.asarray(free_poses(flat, 1, seed=4)[0], float)
    scan = scan_from(flat, pose)
    poses, scores = (a[:10] for a in rank_all(unruled(here), scan))
    moved, moved_scores = (a[:10] for a in rank_all(unruled(there), scan))
    np.testing.assert_allclose(moved_scores, scores, atol=1e-4)
    best = geometry.compose(MOVE, poses[0])
    off = np.asarray(moved, float) - np.asarray(best)
    off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
    # Equal scores may change places.
    same = np.flatnonzero(np.abs(off).max(axis=1) < 1e-3)
    assert len(same) == 1
    assert abs(float(moved_scores[same[0]] - scores[0])) < 1e-4


def test_in_double_precision(tiled):
    """What is rounded then is the score, in ticks."""
    with jax.enable_x64(True):
        scan = dirty_scan(2)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tiles, "_SIDES", (24,))
            made = build_atlas(l_room(), SHORT)
        found = rank_all(unruled(made), scan)
        assert found.score.dtype == np.float64
        assert_same_as_sums(found, made, scan, exact=0.51 / SHORT_BOX.ticks)
    np.testing.assert_array_equal(made.tiles.allowed, tiled.tiles.allowed)


def test_signature_says_what_is_static():
    assert list(inspect.signature(rank_poses).parameters) == [
        "atlas", "scan", "headings", "count",
    ]  # fmt: skip
