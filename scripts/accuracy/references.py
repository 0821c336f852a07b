"""How good are the reference poses? A third opinion, that of the next scan.

Two scans taken one after the other see the same walls. Each is fitted to the end points
of the one before, joined up; no map takes part. What the reference says of that motion
and what our two fits to the map say are compared with it. The difference holds two poses
and the third opinion's own error: divided by √2 it is an upper bound for one pose.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table
from thesis.worlds import Options

from accuracy.consistency import REAL, recording, stacked
from fsmsm_jax import geometry
from fsmsm_jax.alignment import fit_ranges
from fsmsm_jax.world import PolygonMap

STEPS = 12
MOVED, TURNED = (0.02, 0.6), 0.3  # [m], [rad] between scans that are compared
JOINED = 0.3  # [m] between end points that are taken for one wall
CLIP = np.array([0.15, 0.15, np.radians(3)])  # [m, m, rad] no pair counts for more


def tables(options: Options) -> Iterator[Table]:
    """One row a set; without recordings, nothing."""
    if options.data is None:
        return
    rows = []
    for name in REAL:
        if name.endswith("_first60"):
            continue  # the same log
        reference, ours = _errors(options, name, 10 if options.quick else 80)
        rows.append((name, *map(_text, (reference, ours))))
    head = ("set", "reference, x / y / heading", "our fit to the map")
    note = "Root mean square of a pose [cm, cm, °], in the frame of the sensor."
    yield Table("How good are the references?", head, rows, note)


def _text(rms):
    return " / ".join(f"{v:.2f}" for v in rms * [100, 100, 180 / np.pi])


def _errors(options, name, pairs):
    world, log, poses, _, limit = recording(options.data / "real", name, pairs)
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    turned = np.abs(np.remainder(np.diff(poses[:, 2]) + np.pi, 2 * np.pi) - np.pi)
    fit = (moved > MOVED[0]) & (moved < MOVED[1]) & (turned < TURNED)
    usable = np.flatnonzero(fit)
    first = usable[np.linspace(0, len(usable) - 1, pairs).astype(int)]
    before, after = (stacked(log, index, limit) for index in (first, first + 1))
    given = [jnp.asarray(poses[index], float) for index in (first, first + 1)]
    ours = [_fitted(world, s, p) for s, p in zip((before, after), given, strict=True)]
    between = jax.vmap(geometry.between)
    return [
        _rms(opinion - _third(before, after, opinion))
        for opinion in (between(*given), between(*ours))
    ]


@jax.jit
def _fitted(world, scans, poses):
    one = lambda job: fit_ranges(world, job[0], job[1], STEPS)[0]
    return jax.lax.map(one, (scans, poses), batch_size=8)


@jax.jit
def _third(before, after, starts):
    """The motions, by each scan's fit to the end points of the one before."""

    def one(job):
        before, after, start = job
        ends = before.points
        onward = jnp.roll(ends, -1, axis=0)
        near = jnp.linalg.norm(onward - ends, axis=1) < JOINED
        near &= before.echo & jnp.roll(before.echo, -1)
        walls = PolygonMap(ends, jnp.where(near[:, None], onward, ends))
        return fit_ranges(walls, after, start, STEPS)[0]

    return jax.lax.map(one, (before, after, starts))


def _rms(apart):
    """Of one pose, outliers clipped."""
    apart = np.asarray(apart.at[:, 2].set(geometry.wrap(apart[:, 2])), float)
    return np.sqrt(np.mean(np.minimum(np.abs(apart), CLIP) ** 2, axis=0) / 2)
