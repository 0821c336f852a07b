"""Many seeds of one filter in one call, and how their errors are put in a table."""

from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import number

from fsmsm_jax.evaluation.estimates import Paired
from fsmsm_jax.slam.drive import Drive
from fsmsm_jax.slam.filter import Info, SlamConfig, init, run
from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.methods import Name

METHODS: tuple[Name, ...] = ("fastslam1", "fastslam2", "lslam", "lslam2")
PARTICLES = (5, 10, 20, 40)
Numbers = np.ndarray | jax.Array
AT_ONCE = 100  # seeds in one call: more only take memory


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    seeds: int = 400
    quick: bool = False
    out: Path | None = None
    data: Path | None = None

    @property
    def particles(self) -> tuple[int, ...]:
        """Each is a program of its own, compiled for seconds."""
        return PARTICLES[:1] if self.quick else PARTICLES

    @property
    def methods(self) -> tuple[Name, ...]:
        """Likewise."""
        return METHODS[::2] if self.quick else METHODS


class Found(NamedTuple):
    """What a filter made of a drive, for each seed."""

    info: Info
    """Of all steps."""
    landmarks: Landmarks
    """At the end, of the particle that `State.best` names."""


def found(config: SlamConfig, start: Numbers, keys: jax.Array, drive: Drive) -> Found:
    """Run a filter with each key, on one drive or on as many as keys."""
    config = jax.tree.map(jnp.asarray, config)  # numbers change, the program does not
    own = np.ndim(drive.controls) == 4
    parts = []
    for n in range(0, len(keys), AT_ONCE):
        some = slice(n, n + AT_ONCE)
        mine = jax.tree.map(lambda a, some=some: a[some], drive) if own else drive
        part = _found(config, jnp.asarray(start, float), keys[some], mine)
        parts.append(jax.tree.map(np.asarray, part))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


@eqx.filter_jit
def _found(config, start, keys, drive):
    def one(key, drive):
        state, info = run(config, init(config, key, start), drive)
        return Found(info, state.landmarks)

    own = 0 if drive.controls.ndim == 4 else None
    return jax.vmap(one, in_axes=(0, own))(keys, drive)


def spread(sample: np.ndarray) -> str:
    """Mean ± standard deviation over seeds."""
    return f"{np.mean(sample):.3f} ± {np.std(sample):.3f}"


def error_of(sample: np.ndarray) -> str:
    """Standard error of the mean."""
    return number(np.std(sample, ddof=1) / np.sqrt(len(sample)), 2)


def gain(pair: Paired) -> str:
    """Mean difference and how many standard errors it is away from none."""
    return f"{pair.gain:+.3f} ({pair.sigmas:+.1f} s.e.)"


def verdict(met: bool) -> str:
    """Of a goal."""
    return "met" if met else "MISSED"
