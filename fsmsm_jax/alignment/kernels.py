r"""What one ray's disagreement costs: kernels, each a shape of the objective.

A residual is e = real − virtual range [m]. CAER charges |e| for it; a kernel charges
ρ(e), in metres too, smooth at 0 or capped far out. `cost` is ρ. `weight` is ρ′(e)/e,
with which a weighted sum of squares has the slope of Σ ρ: what Gauss-Newton iterates
(iteratively reweighted least squares). `widened` is the same shape at a larger scale.
Descent on a capped kernel starts wide, where no ray is given up yet, and narrows
(graduated non-convexity).

Things that nobody drew stand *in front of* walls. A person shortens a range and never
lengthens it, so e < 0 is often innocent, while e > 0, sight through a drawn wall,
speaks against the pose. `BeamModel` knows this; the others are even.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax.alignment.residuals import geman_mcclure

__all__ = [
    "Absolute",
    "BeamModel",
    "GemanMcClure",
    "Kernel",
    "PseudoHuber",
    "Truncated",
]

_SHARPEST = 1e-3  # [m] below which |e| no longer gains weight: no ray rules alone


class Kernel(eqx.Module):
    """What a residual costs; see the module for the three methods."""

    @abc.abstractmethod
    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost ρ(e) [m] of residuals e [m]; 0 at 0, never negative."""

    @abc.abstractmethod
    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight ρ′(e)/e [1/m] in reweighted least squares; finite, never negative."""

    @abc.abstractmethod
    def widened(self, factor: ScalarLike) -> "Kernel":
        """The same kernel for residuals `factor` times as large."""


class Absolute(Kernel):
    """|e|: CAER itself, at every scale the same."""

    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost |e|, with slope 0 at 0 (JAX gives `abs` slope 1 there)."""
        return e * jnp.sign(e)

    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight 1/|e|, at most 1000."""
        return 1 / jnp.maximum(jnp.abs(e), _SHARPEST)

    def widened(self, factor: ScalarLike) -> "Kernel":
        """Itself: convex, it has nothing to gain."""
        return self


class PseudoHuber(Kernel):
    """CAER made smooth: a parabola inside the width, |e| − width far out."""

    width: ScalarLike = 0.05
    """Where the parabola bends into the straight line [m]; about the noise."""

    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost √(e² + width²) − width."""
        return (jnp.sqrt(1 + jnp.square(e / self.width)) - 1) * self.width

    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight 1/√(e² + width²)."""
        return jnp.reciprocal(jnp.sqrt(1 + jnp.square(e / self.width)) * self.width)

    def widened(self, factor: ScalarLike) -> "Kernel":
        """Bends farther out."""
        return type(self)(self.width * factor)


class GemanMcClure(Kernel):
    """Smooth and capped: no ray costs more than the width."""

    width: ScalarLike = 0.2
    """Half of the cap is reached here [m]; a few standard deviations of the noise."""

    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost width · e² / (e² + width²)."""
        squared = jnp.square(e / self.width)
        return squared / (1 + squared) * self.width

    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight 2 / width at 0, a quarter of that at the width."""
        return geman_mcclure(e, self.width) * 2 / self.width

    def widened(self, factor: ScalarLike) -> "Kernel":
        """Gives rays up farther out."""
        return type(self)(self.width * factor)


class Truncated(Kernel):
    """|e| up to a limit: a ray is right or wrong, not very wrong."""

    limit: ScalarLike = 0.5
    """No ray costs more than this [m]."""

    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost min(|e|, limit)."""
        return jnp.minimum(Absolute().cost(e), self.limit)

    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight 1/|e|, at most 1000; 0 beyond the limit."""
        return jnp.where(jnp.abs(e) < self.limit, Absolute().weight(e), 0.0)

    def widened(self, factor: ScalarLike) -> "Kernel":
        """Gives rays up farther out."""
        return type(self)(self.limit * factor)


class BeamModel(Kernel):
    r"""The sensor's own view: noise, things in front of the wall, and rare surprises.

    The negative logarithm, times the width, of a mixture of a Gaussian and a flat
    background whose level β depends on the sign of e,

    $$ρ(e) = -\sigma \log \frac{\exp(-e^2 / 2\sigma^2) + β}{1 + β},$$

    with β = `short` for e < 0 (somebody stands there) and β = `long` for e ≥ 0 (the
    wall is not where it was drawn). Both sides are alike near 0, so noise alone does
    not push the pose; beyond √(2 log 1/β) widths a ray is given up, for at most
    σ log(1 + 1/β): early and cheaply if it is short, late and dearly if it is long.
    The weight is the probability that the wall itself was seen.

    Reference:
        The beam model of S. Thrun, W. Burgard and D. Fox, Probabilistic Robotics,
        §6.3, with its densities relative to the Gaussian's peak. Levelling each side
        at e = 0 is ours: a step there would pull every ray.
    """

    width: ScalarLike = 0.1
    """σ [m]: the noise of the range, and how well the map is drawn."""
    short: ScalarLike = 0.1
    """Density of ranges too short, relative to the Gaussian's peak; above 0."""
    long: ScalarLike = 0.01
    """Density of ranges too long, relative to the Gaussian's peak; above 0."""

    def cost(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Cost −σ log((exp(−e²/2σ²) + β) / (1 + β))."""
        seen, background = self._densities(e)
        return jnp.log((1 + background) / (seen + background)) * self.width

    def weight(self, e: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Weight 1/σ times the probability that this is the wall."""
        seen, background = self._densities(e)
        return seen / (seen + background) / self.width

    def widened(self, factor: ScalarLike) -> "Kernel":
        """Gives rays up farther out, on both sides."""
        return type(self)(self.width * factor, self.short, self.long)

    def _densities(self, e):
        seen = jnp.exp(-0.5 * (e / self.width) ** 2)
        return seen, jnp.where(e < 0, self.short, self.long)
