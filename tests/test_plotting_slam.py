from importlib import import_module

import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.planes import Sym2

figure = import_module("matplotlib.figure")  # not at fsmsm_jax's import
slam = import_module("fsmsm_jax.plotting.slam")
plotting = import_module("fsmsm_jax.plotting")


@pytest.fixture
def ax():
    return figure.Figure(figsize=(5, 5)).add_subplot()


def a_map():
    """Three landmarks and a free slot; the second is uncertain along 30°."""
    c, s = jnp.array(0.8660254), jnp.array(0.5)
    long = Sym2.along((c, s), jnp.array(4.0), jnp.array(0.25))
    xx, xy, yy = (
        jnp.array([0.01, float(entry), 0.01 + n, 1.0]) for n, entry in enumerate(long)
    )
    places = jnp.array([10.0, 20.0, 30.0, 99.0]), jnp.array([5.0, 6.0, 7.0, 99.0])
    return Landmarks(
        places,
        Sym2(xx, 0 * xy + xy * (jnp.arange(4) == 1), yy),
        jnp.array([1.0, 3.0, 0.5, 0.0]),
    )


POSES = np.stack([np.linspace(8, 30, 6), np.full(6, 4.0), np.zeros(6)], axis=1)


def test_way_and_map_are_where_they_are(ax):
    drawn = slam.plot_slam(ax, POSES, a_map(), sigmas=2.0)
    assert drawn.keys() == {"way", "start", "landmarks", "covariances"}
    np.testing.assert_allclose(drawn["way"].get_xydata(), POSES[:, :2])
    assert drawn["way"].get_color() == plotting.POSE
    np.testing.assert_allclose(drawn["start"].get_xydata(), POSES[:1, :2])
    assert drawn["landmarks"].get_xdata().tolist() == [10, 20, 30]  # no free slot
    ax.figure.canvas.draw()
    ellipses = drawn["covariances"]
    # Two σ on either side: σ is 2 m along 30° and 0.5 m across.
    np.testing.assert_allclose(ellipses.get_widths()[1], 8.0, rtol=1e-4)
    np.testing.assert_allclose(ellipses.get_heights()[1], 2.0, rtol=1e-4)
    assert ellipses.get_angles()[1] % 180 == pytest.approx(30, abs=1e-3)
    np.testing.assert_allclose(ellipses.get_offsets()[2], [30, 7])


def test_truth_is_green_and_may_have_gaps(ax):
    fixes = POSES[:, :2] + 0.5
    fixes[2] = np.nan
    trees = jnp.array([[10.0, 5.5], [20.0, 6.0]])
    drawn = slam.plot_slam(ax, jnp.asarray(POSES), a_map(), fixes, trees)
    assert drawn["reference"].get_color() == plotting.TRUTH
    assert drawn["surveyed"].get_markeredgecolor() == plotting.TRUTH
    np.testing.assert_allclose(drawn["surveyed"].get_xydata(), trees)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["true places", "way", "surveyed landmarks", "landmarks"]
    ax.figure.canvas.draw()


def test_an_empty_map_is_drawn(ax):
    empty = a_map()._replace(evidence=jnp.zeros(4))
    drawn = slam.plot_slam(ax, POSES, empty)
    assert not len(drawn["landmarks"].get_xdata())
    ax.figure.canvas.draw()


def test_errors_against_particles(ax):
    errors = {
        "fastslam1": [np.array([1.0, 3.0]), np.array([1.0, np.nan, 2.0])],
        "lslam_joint": [np.array([0.5, 0.5])],  # tried with the first number only
    }
    drawn = slam.plot_particle_errors(ax, [5, 10], errors)
    lines = {name: bars.lines[0] for name, bars in drawn.items()}
    assert lines["fastslam1"].get_ydata().tolist() == [2.0, 1.5]
    assert lines["lslam_joint"].get_ydata().tolist() == [0.5]
    assert lines["fastslam1"].get_color() == slam.SLAM_COLOURS["fastslam1"]
    # Whiskers come first: one σ over the seeds, then 1.96 standard errors of the mean.
    whiskers = [np.array(c.get_segments()) for c in ax.collections[:2]]
    np.testing.assert_allclose(np.ptp(whiskers[0][0, :, 1]), 2.0)
    np.testing.assert_allclose(np.ptp(whiskers[1][0, :, 1]), 2 * 1.96)
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["5", "10"]
    ax.figure.canvas.draw()


def test_bars_of_time(ax):
    times = {
        "lslam": [(1e-4, 0.9e-4, 1.2e-4), (2e-4, 2e-4, 2e-4)],
        "fastslam2": [(1.6e-4, 1.5e-4, 1.7e-4), (3e-4, 3e-4, 3e-4)],
    }
    drawn = slam.plot_run_times(ax, [5, 40], times)
    heights = [bar.get_height() for bar in drawn["fastslam2"]]
    assert heights == pytest.approx([160, 300])
    edges = [
        (bar.get_x(), bar.get_x() + bar.get_width())
        for bars in drawn.values()
        for bar in bars
    ]
    edges = sorted(edges)
    assert all(a[1] <= b[0] for a, b in zip(edges, edges[1:], strict=False))
    ax.figure.canvas.draw()
