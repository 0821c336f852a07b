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
