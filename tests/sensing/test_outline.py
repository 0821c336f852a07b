"""A scan as a world: walls where it saw some, veils elsewhere.

The oracle of visibility is the reference itself: what a ray meets from another place is
known only if the reference's own ray in that direction ended there.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax import geometry
from fsmsm_jax.sensing import Scan, closed_outline, raycast, seen_space
from fsmsm_jax.world import PolygonMap
from tests.worlds import CENTRE, l_room, square_room

RAYS = 360
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
POSE = np.array([*(CENTRE + [0.3, -0.2]), 0.4])
FAR = 20.0

cast = jax.jit(lambda world, pose: raycast(world, pose, BEARINGS, FAR))
seen = jax.jit(lambda scan: seen_space(scan))


def at(pose, *offset):
    """A pose given in the frame of another."""
    return geometry.compose(jnp.asarray(pose, float), jnp.asarray(offset, float))


def eight(world):
    """The same walls, some of them more than once: rooms of one shape, one program."""
    more = 8 - len(world.start)
    return jax.tree.map(lambda a: jnp.concatenate([a, a[:1].repeat(more, 0)]), world)


L_ROOM, ROOM = eight(l_room()), eight(square_room(6.0))


def scan_at(world, pose, half_view=np.pi):
    """A noise-free panorama; beyond `half_view` [rad] it is blind."""
    ranges = cast(world, jnp.asarray(pose, float))
    valid = jnp.abs(BEARINGS) <= half_view
    echo = valid & (ranges < FAR)
    limit = jnp.asarray(FAR, float)
    return Scan(jnp.where(echo, ranges, FAR), BEARINGS, valid, echo, limit)


def pillar_room():
    """A square room, 6 m wide, with a square pole 1.2 m before `POSE`."""
    ahead = np.asarray(at(POSE, 1.2, 0.0, 0.0))[:2]
    corners = 0.15 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    room, pole = square_room(6.0), PolygonMap.from_outlines(corners + ahead)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), room, pole)


def hits(pose, ranges):
    """End points of the rays cast from a pose, in the frame that it is given in."""
    ends = ranges[:, None] * jnp.stack([jnp.cos(BEARINGS), jnp.sin(BEARINGS)], -1)
    return np.asarray(geometry.transform_points(pose, ends))


def seen_by(reference, points, slack=0.03):
    """Whether points lie where a ray of the reference ended, by asking it."""
    away = np.hypot(*points.T)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    nearest = np.round((bearing + np.pi) / (2 * np.pi / RAYS)).astype(int) % RAYS
    near = [(nearest + k) % RAYS for k in (-1, 0, 1)]
    ranges, echo = np.asarray(reference.ranges), np.asarray(reference.echo)
    step = np.max([np.abs(ranges[n] - ranges[nearest]) for n in near], axis=0)
    off = np.abs(ranges[nearest] - away)
    return echo[nearest] & (off <= step + slack), np.all([echo[n] for n in near], 0)


def test_from_where_it_was_taken_the_scan_is_itself():
    """To 2 % at the corners, which windows may round off (surfaces)."""
    for half_view in (np.pi, 0.75 * np.pi, 0.5 * np.pi):
        scan = scan_at(L_ROOM, POSE, half_view)
        again = np.asarray(cast(seen(scan), jnp.zeros(3)))
        # Walls seen at more than 75° from their normal count as veils.
        inner = np.roll(scan.echo, 1) & scan.echo & np.roll(scan.echo, -1)
        r = np.asarray(scan.ranges)
        jump = np.abs(np.roll(r, -1) - r) > 3.0 * (2 * np.pi / RAYS) * r
        plain = inner & ~jump & ~np.roll(jump, 1)
        assert plain.sum() > 0.8 * np.sum(scan.echo)
        np.testing.assert_allclose(again[plain], scan.ranges[plain], rtol=0.02)


def test_a_hidden_part_is_unknown_and_not_a_wall():
    """Behind the pole nobody looked: from beside it, those rays read range_max."""
    world = pillar_room()
    reference = scan_at(world, POSE)
    for offset in ((0.2, 0.3, 0.5), (-0.3, -0.4, -0.8), (0.0, 0.5, 0.0)):
        motion = jnp.asarray(offset, float)
        true = np.asarray(cast(world, at(POSE, *offset)))
        virtual = np.asarray(cast(seen(reference), motion))
        visible, sure = seen_by(reference, hits(motion, jnp.asarray(true)))
        known = virtual < FAR
        # Of rays whose end the reference saw, nearly all are known, and right.
        assert np.mean(known[visible & sure]) > 0.97
        np.testing.assert_allclose(
            np.median(np.abs(virtual - true)[known & visible]), 0, atol=0.005
        )
        # Those that end in its shadow claim nothing; an edge may take a ray or two.
        hidden = ~visible
        assert hidden.sum() >= 4
        assert np.sum(known & hidden) <= 2
        # The thesis's polygon has walls there that nobody saw.
        closed = np.asarray(cast(closed_outline(reference), motion))
        assert (closed < FAR).all()
        assert np.abs(closed - true)[hidden].mean() > 0.1


def test_behind_a_partial_view_nobody_knows():
    scan = scan_at(ROOM, POSE, np.pi / 2)
    ranges = np.asarray(cast(seen(scan), jnp.array([0.4, 0.1, 0.0])))
    behind = np.abs(np.asarray(BEARINGS)) > np.pi / 2 + 0.3
    ahead = np.abs(np.asarray(BEARINGS)) < np.pi / 2 - 0.3
    np.testing.assert_array_equal(ranges[behind], FAR)
    assert (ranges[ahead] < FAR).all()


def test_from_behind_one_looks_into_a_partial_view():
    """A veil hides what is behind it, but nothing from who stands there: a sensor of
    180° that has moved backwards sees the walls ahead, 0.3 m farther away."""
    world = ROOM
    for half_view in (np.pi / 2, 0.75 * np.pi):
        reference = scan_at(world, POSE, half_view)
        motion = (-0.3, 0.1, 0.2)
        virtual = np.asarray(cast(seen(reference), jnp.asarray(motion, float)))
        true = np.asarray(cast(world, at(POSE, *motion)))
        ahead = np.abs(np.asarray(BEARINGS) + 0.2) < half_view - 0.3
        np.testing.assert_allclose(virtual[ahead], true[ahead], rtol=0.02)
        behind = np.abs(geometry.wrap(BEARINGS + 0.2)) > half_view + 0.3
        np.testing.assert_array_equal(virtual[behind], FAR)


def test_where_no_echo_came_there_is_no_wall():
    """An open door: the ray through it says free space, and nothing farther."""
    full = scan_at(ROOM, POSE)
    door = jnp.abs(BEARINGS) < 0.3
    echo = full.echo & ~door
    scan = Scan(
        jnp.where(echo, full.ranges, FAR), BEARINGS, full.valid, echo, full.range_max
    )
    ranges = np.asarray(cast(seen(scan), jnp.array([0.1, 0.1, 0.0])))
    np.testing.assert_array_equal(ranges[np.abs(np.asarray(BEARINGS)) < 0.25], FAR)
    assert (ranges[np.abs(np.asarray(BEARINGS)) > 0.4] < FAR).all()


def test_inside_is_what_rays_have_crossed():
    """Not outside the room, not in the blind half, not behind the pole."""
    world = pillar_room()
    space = seen(scan_at(world, POSE, np.pi / 2))
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (4000, 2))
    away, bearing = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    own = np.asarray(
        jax.jit(lambda b: raycast(world, jnp.asarray(POSE, float), b, FAR))(
            jnp.asarray(bearing, float)
        )
    )
    crossed = (away < own) & (np.abs(bearing) < np.pi / 2)
    inside = np.asarray(space.contains(jnp.asarray(points, float)))
    # Only within a ray's width of the pole's edges and of the view's do they differ.
    assert np.mean(inside != crossed) < 0.01
    assert 0.1 < crossed.mean() < 0.5


def test_closed_outline_joins_everything_as_measured():
    scan = scan_at(L_ROOM, POSE, np.pi / 2)
    world = closed_outline(scan)
    assert world.solid is None
    np.testing.assert_allclose(world.start, scan.points, atol=1e-6)
    np.testing.assert_allclose(world.end, np.roll(scan.points, -1, axis=0), atol=1e-6)


def test_a_scan_of_nothing_is_a_world_of_nothing():
    nobody = jnp.zeros(RAYS, bool)
    limit = jnp.asarray(FAR, float)
    scan = Scan(jnp.full(RAYS, FAR), BEARINGS, nobody, nobody, limit)
    for pose in (jnp.zeros(3), jnp.array([0.2, -0.1, 0.5])):
        np.testing.assert_array_equal(cast(seen(scan), pose), FAR)


def test_a_batch_is_a_loop():
    scans = [scan_at(L_ROOM, POSE, half_view) for half_view in (np.pi, np.pi / 2)]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scans)
    worlds = jax.jit(jax.vmap(lambda scan: seen_space(scan)))(both)
    for index, scan in enumerate(scans):
        alone = seen(scan)
        np.testing.assert_array_equal(worlds.solid[index], alone.solid)
        error = np.abs(np.asarray(worlds.start[index]) - np.asarray(alone.start))
        assert np.mean(error < 1e-4) > 0.98  # windows on the verge (test_surfaces)
