"""Intervals hold the truth as often as they say; closed forms by scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from fsmsm_jax.evaluation import mean_of, paired, quantile_of, share_of, spread_of

EXPERIMENTS = 400


@pytest.mark.parametrize("n", [60, 200])
@pytest.mark.parametrize(
    ("estimate", "truth"),
    [
        (mean_of, 1.0),
        (quantile_of, math.log(2)),
        (lambda x: quantile_of(x, 0.9), math.log(10)),
        (lambda x: share_of(x < 0.1), 1 - math.exp(-0.1)),
    ],
)
def test_intervals_cover(estimate, truth, n):
    samples = np.random.default_rng(n).exponential(size=(EXPERIMENTS, n))
    found = [estimate(sample) for sample in samples]
    covered = np.mean([e.low <= truth <= e.high for e in found])
    assert 0.92 < covered < 0.995
    assert abs(np.mean([e.value for e in found]) - truth) < 0.05
    assert all(e.low <= e.value <= e.high for e in found)


@pytest.mark.parametrize(("yes", "n"), [(0, 20), (7, 20), (195, 195)])
def test_share_is_wilsons(yes, n):
    expected = stats.binomtest(yes, n).proportion_ci(method="wilson")
    found = share_of(np.arange(n) < yes)
    assert found.value == yes / n
    np.testing.assert_allclose(found[1:], expected, atol=1e-6)


def test_few_draws_say_little():
    assert mean_of(np.array([2.0]))[1:] == (-math.inf, math.inf)
    assert quantile_of(np.array([2.0, 3.0]))[1:] == (-math.inf, math.inf)
    assert quantile_of(np.arange(30.0), 0.9).high == math.inf


def test_one_nan_is_not_hidden():
    spread = spread_of(np.array([1.0, np.nan, 2.0]))
    assert all(np.isnan(part.value) for part in spread)
    with pytest.raises(ValueError, match="empty"):
        share_of(np.zeros(0, bool))


def test_paired_differences():
    rng = np.random.default_rng(5)
    world = rng.normal(size=200)  # what both have in common
    ours, theirs = world + rng.normal(size=200) * 0.1, world + 0.05
    gain = paired(ours, theirs)
    # 0.1 / √200 = 0.007, told to 5 % by 200 of them; three of it about the mean.
    assert gain.error == pytest.approx(0.0071, rel=0.2)
    assert gain.gain == pytest.approx(0.05, abs=0.021)
    assert paired(ours, ours).sigmas == 0
    with pytest.raises(ValueError, match="two or more"):
        paired(ours[:1], theirs[:1])
