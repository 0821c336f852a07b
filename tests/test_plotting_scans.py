from importlib import import_module

import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.sensing import Scan, panorama, seen_space
from fsmsm_jax.world import PolygonMap

figure = import_module("matplotlib.figure")  # not at fsmsm_jax's import
colours = import_module("matplotlib.colors")
plotting = import_module("fsmsm_jax.plotting")

ROOM = PolygonMap.from_outlines([[3, 2], [7, 2], [7, 5], [3, 5]])
QUARTER = jnp.array([10.0, -20.0, np.pi / 2])  # a quarter turn, and far away


@pytest.fixture
def ax():
    return figure.Figure(figsize=(5, 5)).add_subplot()


def segments(lines):
    return np.array(lines.get_segments())


def test_walls_and_veils_are_drawn_apart(ax):
    solid = jnp.array([True, False, True, True])
    world = PolygonMap(ROOM.start, ROOM.end, solid)
    drawn = plotting.plot_seen_space(ax, world, color=plotting.RIVAL)
    np.testing.assert_allclose(segments(drawn.veils), [[[7, 2], [7, 5]]])
    assert len(segments(drawn.walls)) == 3
    assert colours.same_color(drawn.veils.get_colors()[0], plotting.RIVAL)
    assert colours.same_color(drawn.walls.get_colors()[0], plotting.WALL)
    # Dotted: not to be taken for a wall in a print without colours.
    assert drawn.veils.get_linestyles() != drawn.walls.get_linestyles()
    ax.figure.canvas.draw()


def test_a_pose_places_all_of_it(ax):
    drawn = plotting.plot_seen_space(ax, ROOM, QUARTER)
    # A quarter turn takes (x, y) to (−y, x); float32 has 1e-6 of 20 m.
    corners = np.array([[8, -17], [8, -13], [5, -13], [5, -17]])
    starts = segments(drawn.walls)[:, 0]
    np.testing.assert_allclose(starts, corners, atol=1e-5)
    np.testing.assert_allclose(drawn.space.get_xy()[:4], corners, atol=1e-5)
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left <= 5 < 8 <= right
    assert bottom <= -17 < -13 <= top


def test_half_a_view_is_half_a_disc_with_a_veil_as_its_straight_side(ax):
    ahead = Scan.from_ranges(np.full(181, 2.0), -np.pi / 2, np.pi / 180)
    drawn = plotting.plot_seen_space(ax, seen_space(panorama(ahead, 360)))
    walls, veils = segments(drawn.walls), segments(drawn.veils)
    # Rays that saw nothing end in the sensor: they are not drawn, as walls or as veils.
    assert len(walls) == 180
    # A round wall is taken for short straight ones, some millimetres off.
    np.testing.assert_allclose(np.linalg.norm(walls, axis=-1), 2, atol=0.01)
    assert len(veils) == 2
    np.testing.assert_allclose(veils[..., 0], 0, atol=1e-4)
    assert np.linalg.norm(veils[:, 0] - veils[:, 1], axis=1) == pytest.approx(
        [2, 2], abs=0.01
    )
