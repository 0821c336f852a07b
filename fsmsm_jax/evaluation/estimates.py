r"""What a sample says of the errors it was drawn from: a number, and how sure it is.

Matching errors have long tails: most answers are millimetres off and a few are metres.
So a median and a mean tell two stories, and the mean's is the uncertain one. Every
number here comes with an interval that holds the true one in 95 of 100 experiments:

- a median (any quantile) lies between two order statistics, whatever the distribution,
  since how many of n draws fall under it is binomial;
- a mean, by the central limit theorem, within 1.96 standard errors; with tails as long
  as these it takes some hundred draws to be true;
- a share by Wilson's interval, which does not claim certainty at 100 %.

Draws are taken to be independent. Two methods on the same cases (or seeds) are better
compared by their *differences*, case by case: `mean_of(ours - theirs)` is the interval,
`paired` says how many standard errors lie between the two.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Shaped
from scipy import stats

__all__ = [
    "Estimate",
    "Paired",
    "Spread",
    "mean_of",
    "paired",
    "quantile_of",
    "share_of",
    "spread_of",
]

Sample = Shaped[np.ndarray, "n"] | Shaped[Array, "n"]

_Z = 1.959964  # of the standard normal, 2.5 % above


class Estimate(NamedTuple):
    """A number and its 95 % confidence interval."""

    value: float
    low: float
    high: float


class Spread(NamedTuple):
    """How errors are distributed; NaN if any is NaN."""

    median: Estimate
    mean: Estimate
    p90: Estimate
    """The error that nine of ten stay under."""


class Paired(NamedTuple):
    """By how much one method is better than another on the same seeds."""

    gain: float
    """Mean of theirs less ours."""
    error: float
    """Its standard error."""

    @property
    def sigmas(self) -> float:
        """The gain in standard errors; 0 where nothing differs."""
        return self.gain / self.error if self.error > 0 else 0.0


def mean_of(sample: Sample) -> Estimate:
    """Mean ± 1.96 standard errors; a single draw has an infinite one.

    Example:
        >>> [round(v, 3) for v in mean_of(np.array([1.0, 2.0, 3.0, 6.0]))]
        [3.0, 0.883, 5.117]
    """
    sample = _checked(sample)
    value = float(np.mean(sample))
    if sample.size == 1:
        return Estimate(value, -math.inf, math.inf)
    error = _Z * float(np.std(sample, ddof=1)) / math.sqrt(sample.size)
    return Estimate(value, value - error, value + error)


def quantile_of(sample: Sample, q: float = 0.5) -> Estimate:
    """Quantile between its order statistics; infinite where n is too small to say.

    Example:
        >>> quantile_of(np.arange(100.0))
        Estimate(value=49.5, low=39.0, high=60.0)
    """
    ordered = np.sort(_checked(sample))
    if np.isnan(ordered[-1]):
        return Estimate(math.nan, math.nan, math.nan)
    n = ordered.size
    # k draws lie under the true quantile with 95 % probability for low < k ≤ high.
    low, high = (int(k) for k in stats.binom.ppf([0.025, 0.975], n, q) - [1, 0])
    return Estimate(
        float(np.quantile(ordered, q)),
        float(ordered[low]) if low >= 0 else -math.inf,
        float(ordered[high]) if high < n else math.inf,
    )


def share_of(yes: Bool[np.ndarray, "n"] | Bool[Array, "n"]) -> Estimate:
    """Share of true ones, with Wilson's score interval.

    Example:
        >>> [round(v, 3) for v in share_of(np.ones(195, bool))]
        [1.0, 0.981, 1.0]

    Reference:
        E. B. Wilson, "Probable inference", J. Am. Stat. Assoc. 22, 1927.
    """
    yes = _checked(yes)
    n, p = yes.size, float(np.mean(yes))
    centre = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
    half = _Z * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2)) / (1 + _Z**2 / n)
    return Estimate(p, max(0.0, centre - half), min(1.0, centre + half))


def spread_of(sample: Sample) -> Spread:
    """Median, mean and 90th percentile."""
    return Spread(quantile_of(sample), mean_of(sample), quantile_of(sample, 0.9))


def paired(ours: Sample, theirs: Sample) -> Paired:
    """How much smaller our errors are than theirs, seed by seed.

    Raises:
        ValueError: not as many of ours as of theirs, or fewer than two.

    Example:
        >>> gain = paired(np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.5, 4.5]))
        >>> gain.gain, round(gain.error, 3), round(gain.sigmas, 2)
        (1.0, 0.289, 3.46)
    """
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if ours.shape != theirs.shape or len(ours) < 2:
        raise ValueError(
            "expected as many of ours as of theirs, two or more, got "
            f"{len(ours)} and {len(theirs)}"
        )
    gains = theirs - ours
    error = np.std(gains, ddof=1) / np.sqrt(len(gains))
    return Paired(float(np.mean(gains)), float(error))


def _checked(sample: Sample) -> np.ndarray:
    sample = np.asarray(sample, float)
    if sample.size == 0:
        raise ValueError("a statistic of nothing: the sample is empty")
    return sample
