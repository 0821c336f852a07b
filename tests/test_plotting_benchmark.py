"""The picture of how time grows."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from fsmsm_jax.plotting.benchmark import plot_scaling

SIZES = [10.0, 40.0, 160.0]
SECONDS = [(0.001, 0.002, 0.004), (0.002, 0.003, 0.005), (0.004, 0.006, 0.007)]


def test_medians_in_milliseconds_and_a_slope_of_one():
    ax = Figure().add_subplot()
    drawn = plot_scaling(ax, SIZES, SECONDS, "a query")
    np.testing.assert_allclose(drawn[0].get_xydata(), [[10, 2], [40, 3], [160, 6]])
    linear = ax.lines[-1].get_xydata()
    np.testing.assert_allclose(linear, [[10, 2], [40, 8], [160, 32]])
    assert ax.get_xscale() == ax.get_yscale() == "log"
    (segments,) = (np.asarray(c.get_segments()) for c in drawn[2])
    np.testing.assert_allclose(segments[0][:, 1], [1, 4])  # the quartiles


def test_as_many_times_as_sizes():
    with pytest.raises(ValueError, match="2 sizes, but times of 3"):
        plot_scaling(Figure().add_subplot(), SIZES[:2], SECONDS, "a query")
