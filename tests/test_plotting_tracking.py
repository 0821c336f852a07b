from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import Track
from fsmsm_jax.world import OccupancyGrid, PolygonMap

figure = import_module("matplotlib.figure")  # not at fsmsm_jax's import
colours = import_module("matplotlib.colors")
plotting = import_module("fsmsm_jax.plotting")

HALL = PolygonMap.from_outlines([[-5, 2], [35, 2], [35, 30], [-5, 30]])


@pytest.fixture
def ax():
    return figure.Figure(figsize=(5, 5)).add_subplot()


def a_track(status, pose=None):
    """Poses on a diagonal, 1 m apart."""
    n = len(status)
    if pose is None:
        pose = np.stack([10.0 + np.arange(n), 12.0 + np.arange(n), np.full(n, 0.7)], 1)
    one = np.ones(n)
    covariance = np.tile(np.eye(3), (n, 1, 1))
    return Track(pose, covariance, np.array(status), one, one, one)


STORY = ["lost", "localised", "tracking", "tracking", "skipped", "lost", "lost"]
STORY += ["localised", "tracking", "doubted"]


def test_each_stretch_is_drawn_as_what_it_is(ax):
    drawn = plotting.plot_track(ax, HALL, a_track(STORY))
    at = lambda name: np.array(drawn[name].get_segments())[:, 1, 0].tolist()
    points = lambda name: drawn[name].get_xdata().tolist()
    assert at("tracking") == [12, 13, 18]
    assert at("skipped") == [14]
    assert points("lost") == [10, 15, 16]
    assert points("localised") == [11, 17]
    assert points("start") == [11]
    assert points("end") == [19]
    assert at("doubted") == [19]
    blue = colours.to_rgb(plotting.POSE)
    np.testing.assert_allclose(drawn["tracking"].get_colors()[0][:3], blue)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == [
        "tracked, 3 scans",
        "dead reckoning, 1 scan",
        "tracked, in doubt, 1 scan",
        "lost: best guess, 3 scans",
        "found on the map, 2 scans",
    ]
    ax.figure.canvas.draw()


def test_no_line_leads_over_a_kidnap(ax):
    """Neither to the place where it was found, nor out of one where it was lost."""
    drawn = plotting.plot_track(ax, HALL, a_track(["tracking", "lost", "tracking"]))
    assert not drawn["tracking"].get_segments()


def test_reference_is_green_and_may_have_gaps(ax):
    track = a_track(["tracking"] * 4)
    reference = track.pose + 0.3
    reference[1] = np.nan
    drawn = plotting.plot_track(ax, HALL, track, jnp.asarray(reference))
    assert drawn["reference"].get_color() == plotting.TRUTH
    np.testing.assert_allclose(drawn["reference"].get_xdata(), reference[:, 0])


def test_frame_is_the_way_and_what_is_around_it(ax):
    plotting.plot_track(ax, HALL, a_track(["tracking"] * 4))
    assert ax.get_xlim() == pytest.approx((5, 18))
    assert ax.get_ylim() == pytest.approx((7, 20))
    plotting.plot_track(ax, HALL, a_track(["tracking"] * 24))
    assert ax.get_ylim()[1] == pytest.approx(30.5)  # no farther than the map


def test_a_robot_that_was_never_found_leaves_an_empty_map(ax):
    track = a_track(["lost"] * 3, np.full((3, 3), np.nan))
    world = OccupancyGrid.from_cells(np.zeros((40, 40), int), 0.5)
    drawn = plotting.plot_track(ax, world, track)
    assert drawn.keys() == {"lost"}
    assert ax.get_xlim()[1] > 19
    ax.figure.canvas.draw()


def test_band_is_three_sigma_and_errors_are_scaled(ax):
    times = np.linspace(5.0, 6.0, 11)
    errors = np.linspace(-0.01, 0.02, 11)
    line, band = plotting.plot_error_over_time(ax, times, errors, np.full(11, 0.01))
    np.testing.assert_allclose(line.get_ydata(), 1e3 * errors)
    y = band.get_paths()[0].vertices[:, 1]
    assert (y.min(), y.max()) == pytest.approx((-30, 30))


def test_band_has_gaps_where_nothing_is_known(ax):
    errors, sigma = np.zeros(12), np.full(12, 0.01)
    errors[3], sigma[8] = np.nan, np.inf
    line, band = plotting.plot_error_over_time(ax, np.arange(12.0), errors, sigma)
    assert len(band.get_paths()) == 3
    assert np.isfinite(ax.get_ylim()).all()
    assert np.isnan(line.get_ydata()[3])


def test_particles_point_along_their_heading_and_the_dead_are_gone(ax):
    poses = jnp.array([[1.0, 5.0, 0.0], [2.0, 6.0, np.pi / 2], [3.0, 7.0, 1.0]])
    weights = jnp.array([0.25, 0.75, 0.0])
    strokes, arrow = plotting.plot_particles(ax, HALL, poses, weights, poses[1])
    one, other = np.array(strokes.get_segments())
    np.testing.assert_allclose(one[0], [1, 5], atol=1e-6)
    along, up = one[1] - one[0], other[1] - other[0]
    assert along[0] > 0.1
    np.testing.assert_allclose([along[1], up[0]], 0, atol=1e-6)
    np.testing.assert_allclose(strokes.get_alpha(), [1 / 3, 1])
    assert arrow.get_color() == plotting.TRUTH
    ax.figure.canvas.draw()


def test_a_great_cloud_without_truth(ax):
    poses = jax.random.uniform(jax.random.key(0), (5000, 3), minval=3.0, maxval=9.0)
    strokes, arrow = plotting.plot_particles(ax, HALL, poses, jnp.full(5000, 1 / 5000))
    assert arrow is None
    assert len(strokes.get_segments()) == 5000
    assert np.all(strokes.get_alpha() == 1.0)
