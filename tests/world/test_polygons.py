import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.world import PolygonMap

ROOM = [[11, 21], [15, 21], [15, 24.5], [11, 24.5]]
PILLAR = [[12, 22], [13, 22], [12.5, 23]]


def test_outlines_close_and_join():
    world = PolygonMap.from_outlines(ROOM, np.array(PILLAR))
    np.testing.assert_allclose(world.start, [*ROOM, *PILLAR])
    np.testing.assert_allclose(world.end[3], ROOM[0])
    np.testing.assert_allclose(world.end[6], PILLAR[0])
    np.testing.assert_allclose(world.end[0], ROOM[1])


@pytest.mark.parametrize(
    ("outlines", "message"),
    [
        ([], "at least one outline"),
        ([ROOM, ROOM[:2]], r"outline 1 must be .* got \(2, 2\)"),
        ([np.ones((4, 3))], r"got \(4, 3\)"),
        ([np.ones(6)], r"got \(6,\)"),
        ([[[0, 0], [1, np.nan], [1, 1]]], "outline 0 .* not finite"),
        ([[[0, 0], [1, np.inf], [1, 1]]], "not finite"),
    ],
)
def test_bad_outlines_are_refused(outlines, message):
    with pytest.raises(ValueError, match=message):
        PolygonMap.from_outlines(*outlines)


def test_veils_are_no_walls_to_measure_distance_from():
    room = PolygonMap.from_outlines(ROOM)
    assert room.solid is None
    points = jnp.array([[13.0, 21.5], [14.8, 23.0], [11.1, 24.3]])
    np.testing.assert_allclose(room.distance_at(points), [0.5, 0.2, 0.1], atol=1e-5)
    # Without the floor (the first segment), the others are as near as they were.
    solid = jnp.array([False, True, True, True])
    veiled = eqx.tree_at(
        lambda w: w.solid, room, solid, is_leaf=lambda leaf: leaf is None
    )
    np.testing.assert_allclose(veiled.distance_at(points), [2.0, 0.2, 0.1], atol=1e-5)
    np.testing.assert_array_equal(veiled.contains(points), True)
    nothing = eqx.tree_at(lambda w: w.solid, veiled, jnp.zeros(4, bool))
    np.testing.assert_array_equal(nothing.distance_at(points), np.inf)
    np.testing.assert_allclose(veiled.distance_at(points[0]), 2.0, atol=1e-5)
