"""Settings of FMI-SPOMF, and what its similarity is worth.

What shapes the grids over (θ, log ρ) is static, floats included: the grids are numbers
in the compiled program. The threshold alone may change, or be traced, without another.
"""

import equinox as eqx
from jaxtyping import ScalarLike

__all__ = ["FmiConfig"]


class FmiConfig(eqx.Module):
    """How images are compared."""

    angles: int = eqx.field(default=256, static=True)
    """Bins over half a turn; 0.7° each, divided by parabola."""
    radii: int = eqx.field(default=128, static=True)
    """Bins over log ρ; 2.7 % of scale each, divided by parabola."""
    lowest: float = eqx.field(default=0.012, static=True)
    """Lowest frequency looked at [cycles a pixel]."""
    highest: float = eqx.field(default=0.35, static=True)
    """Highest frequency looked at [cycles a pixel]."""
    largest_scale: float = eqx.field(default=2.0, static=True)
    """Scales are sought from its inverse to this."""
    candidates: int = eqx.field(default=4, static=True)
    """Peaks over (θ, log ρ) that are tried, each both ways up."""
    kept: int = eqx.field(default=1, static=True)
    """Of these, how many are fitted and judged."""
    steps: int = eqx.field(default=6, static=True)
    """Steps of Gauss-Newton, in each of two rounds."""
    threshold: ScalarLike = 0.7
    """Similarity w from which a registration counts as converged.

    0.7 is what no look-alike reached. Over 500 pairs of photographs each
    (`scripts/reproduce_fmi.py`), w of related ones is 0.91 or more in 99 %; noise of
    10 % and of 30 % of the contrast, in both, lowers its median to 0.83 and 0.56;
    mirrored ones, nearly symmetric scenes among them, come to 0.65 at most, unrelated
    ones to 0.21 (80 pixels a side) and 0.11 (224). So 0.7 is safe, and refuses many a
    noisy pair that is right; where no mirror is to be feared, 0.25 refuses few."""

    def __check_init__(self):
        if not 1 <= self.kept <= self.candidates or self.steps < 1:
            raise ValueError(
                "expected 1 <= kept <= candidates and at least one step, got "
                f"{self.kept}, {self.candidates}, {self.steps}"
            )
        if not 0 < self.lowest < self.highest <= 0.5:
            raise ValueError(
                "expected 0 < lowest < highest <= 0.5 cycles a pixel, got "
                f"{self.lowest}, {self.highest}"
            )
