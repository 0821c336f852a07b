"""From many places to one: what a step may do to those that it is given."""

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.localisation import settle
from fsmsm_jax.sensing import Lidar, raycast
from tests.worlds import CENTRE, l_room

SCALES = [0.2, 0.15, 0.1]
TRUTH = jnp.asarray([*(CENTRE + [0.6, 0.3]), 1.1], float)


def test_a_polish_makes_nothing_much_worse():
    """Poses up to half a metre and 17° off: some are pulled away, and come back."""
    world, lidar = l_room(), Lidar.create(90, np.pi, noise=0.02, range_max=12.0)
    exact = raycast(world, TRUTH, lidar.bearings, lidar.range_max)
    scan = lidar.measure(jax.random.key(0), exact)
    off = np.random.default_rng(1).uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.3], (64, 3))
    start = TRUTH[None] + jnp.asarray(off, float)
    before, evidence_before = jax.jit(settle._judge)(world, scan, start)
    polish = jax.jit(lambda *given: settle._polish(world, scan, given, SCALES))
    found, score, evidence = polish(start, before, evidence_before)
    kept = np.all(np.asarray(found) == np.asarray(start), axis=1)
    assert 0 < kept.sum() < 64
    assert (np.asarray(score)[~kept] > np.asarray(before)[~kept] - 0.1).all()
    np.testing.assert_array_equal(score[kept], before[kept])
    for new, old in zip(evidence, evidence_before, strict=True):
        np.testing.assert_array_equal(new[kept], old[kept])
    # What starts within the kernels' reach ends where the noise lets it.
    close = np.abs(off).max(axis=1) < 0.15
    assert close.sum() > 1
    near = np.linalg.norm(np.asarray(found - TRUTH[None])[:, :2], axis=1) < 0.02
    assert near[close].all()
