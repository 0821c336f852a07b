"""The dials of FSMSM, and what it reports.

The thesis climbs to ν = 5 and casts about 250 virtual scans a match. Most of them buy
what a few steps along the exact derivative of the cast give better. So the default
stops at ν = 2, rehearses distinct headings instead of neighbours, finishes with
`fit.fit_ranges` and casts 92. It need not be told the noise, and its mean errors are
half as large without map noise and a quarter smaller with. `FsmsmConfig.published`
climbs on, and follows the thesis's program in everything that is compared.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from fsmsm_jax.alignment.orientation import METHODS

__all__ = ["Alignment", "FsmsmConfig"]


class FsmsmConfig(eqx.Module):
    """How FSMSM goes about it."""

    orientation: str = eqx.field(default="fourier_mellin", static=True)
    """A name in `orientation.METHODS`."""
    levels: tuple[int, ...] = eqx.field(default=(1, 2), static=True)
    """Sampling degrees ν, in the order they are climbed."""
    translations: tuple[int, ...] = eqx.field(default=(3, 5), static=True)
    """I_T(ν): steps of the position law at each level."""
    finish: int = eqx.field(default=6, static=True)
    """Gauss-Newton steps after the last level; 0 to end with that."""
    max_steps: int = eqx.field(default=10, static=True)
    """Outer steps at a level after which the next one comes anyway."""
    settle: int = eqx.field(default=0, static=True)
    """Outer steps at a level before the heading may count as come to rest."""
    headings: int = eqx.field(default=5, static=True)
    """Distinct headings rehearsed, for "fourier_mellin": the best in the box that are
    `apart` (`theseus.distinct_headings`). 0 for the thesis's 2^ν about one peak."""
    apart: ScalarLike = 0.1
    """Least angle between them [rad]."""
    cap: ScalarLike = 0.5
    """Rays that differ by more [m] never pull, and count just this much in CAER."""
    window: int = eqx.field(default=128, static=True)
    """Rehearsed are the most similar candidate and `window` / 2^ν to either side."""
    memory: str = eqx.field(default="heading", static=True)
    """What is remembered of the best rehearsal so far: its "heading" (the thesis's
    text), the "turn" that led to it (its program for fm and uf, erratum E14), or its
    "pose" after the rehearsal, from which every step then goes on (its program for
    x1; the better choice for "first_principles")."""
    keep_least: bool = eqx.field(default=True, static=True)
    """Of the positions on the way keep the one of least CAER, and not the last."""
    gate: ScalarLike = 0.25
    """Rays that differ by more than gate · N · last step do not pull (`translate`)."""
    box: tuple[ScalarLike, ScalarLike] = (0.2, math.pi / 4)
    """Half width of the box around the estimate in which the pose lies [m, rad]."""
    stray: ScalarLike = 1.3
    """Recover beyond this many boxes from the first estimate."""
    caer_limit: ScalarLike = math.inf
    """CAER per ray [m] above which the last level ends in a recovery."""
    max_recoveries: int = eqx.field(default=40, static=True)
    """Fresh starts before giving up."""

    def __check_init__(self):
        if len(self.levels) != len(self.translations) or not self.levels:
            raise ValueError(
                f"levels {self.levels} want one number of translations each, got "
                f"{self.translations}"
            )
        if min(self.levels) < 0 or max(self.levels) > 10:
            raise ValueError(
                f"sampling degrees lie in 0..10 (2^ν virtual scans at once), got "
                f"{self.levels}"
            )
        if self.orientation not in METHODS:
            raise ValueError(
                f"no method {self.orientation!r}: choose from {', '.join(METHODS)}"
            )
        if self.memory not in ("heading", "turn", "pose"):
            raise ValueError(
                f"memory must be 'heading', 'turn' or 'pose', got {self.memory!r}"
            )

    @classmethod
    def published(
        cls,
        orientation: str = "fourier_mellin",
        sigma_range: ScalarLike = 0.0,
        sigma_map: ScalarLike = 0.0,
    ) -> "FsmsmConfig":
        """The settings of the thesis's evaluation, as its program had them.

        Args:
            orientation: "fourier_mellin" (fm), "procrustes" (uf) or
                "first_principles" (x1).
            sigma_range: true noise of the ranges [m], which the program is told.
            sigma_map: true noise of the map's points [m], likewise.

        Reference:
            Section 6.5 of the thesis (final text), erratum E8.
        """
        noise = jnp.hypot(jnp.asarray(sigma_range), jnp.asarray(sigma_map))
        first = orientation == "first_principles"
        return cls(
            orientation=orientation,
            headings=0,
            cap=math.inf,
            levels=(2, 3, 4) if first else (2, 3, 4, 5),
            translations=(2, 2, 2) if first else (3, 4, 5, 6),
            finish=0,
            max_steps=20 if first else 10,
            settle=1 if first else 0,
            memory="pose" if first else "turn",
            keep_least=not first,
            stray=2.0 if first else math.inf,
            caer_limit=4 * noise + 0.001,
            max_recoveries=100,
        )

    @classmethod
    def scan_to_scan(cls, translations: int = 2) -> "FsmsmConfig":
        """The settings of FSM, scan against scan (`match_scans`).

        Args:
            translations: I_T(ν) = translations · (1 + ν) steps of the position law: 2
                in the thesis's program as its defaults run it, 5 in its text, with
                which its published table comes out (`scripts/reproduce_fsm.py`).

        Reference:
            Algorithm XXIV of the thesis and the defaults of its program (`fsm.h`).
        """
        levels = (0, 1, 2, 3)
        return cls(
            headings=0,
            cap=math.inf,
            levels=levels,
            translations=tuple(translations * (1 + nu) for nu in levels),
            finish=0,
            max_steps=200,
            memory="turn",
            stray=math.inf,
            max_recoveries=10,
        )


class Alignment(NamedTuple):
    """What `fsmsm` found."""

    pose: Float[Array, "*batch 3"]
    """Pose [x, y, θ] of the sensor in the map frame [m, m, rad]; always finite."""
    caer_per_ray: Float[Array, "*batch"]
    """CAER per valid ray [m]; without a finish, at the last position scanned."""
    converged: Bool[Array, "*batch"]
    """Whether it ended inside the map, and under the CAER limit."""
    steps: Int[Array, "*batch"]
    """Outer steps taken."""
    scans: Int[Array, "*batch"]
    """Virtual scans of N rays cast."""
    recoveries: Int[Array, "*batch"]
    """Fresh starts."""
