"""From many places to one: what a step may do to those that it is given."""

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.localisation import settle
from fsmsm_jax.sensing import Lidar, raycast
from tests.worlds import CENTRE, l_room

SCALES = jnp.array([0.2, 0.15, 0.1])
TRUTH = jnp.asarray([*(CENTRE + [0.6, 0.3]), 1.1], float)


def test_a_polish_makes_nothing_much_worse():
    """Poses up to half a metre and 17° off: some are pulled away, and come back."""
    world, lidar = l_room(), Lidar.create(90, np.pi, noise=0.02, range_max=12.0)
    exact = raycast(world, TRUTH, lidar.bearings, lidar.range_max)
    scan = lidar.measure(jax.random.key(0), exact)
    off = np.random.default_rng(1).uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.3], (64, 3))
    start = TRUTH[None] + jnp.asarray(off, float)
    polish, judge = jax.jit(settle._polish), jax.jit(settle._judge)
    found, score, evidence = polish(world, scan, start, SCALES)
    before, evidence_before = judge(world, scan, start)
    kept = np.all(np.asarray(found) == np.asarray(start), axis=1)
    assert 0 < kept.sum() < 64
    assert (np.asarray(score)[~kept] > np.asarray(before)[~kept] - 0.1).all()
    # Two programs: 90 float32 terms in another order.
    np.testing.assert_allclose(score[kept], before[kept], atol=1e-5)
    for new, old in zip(evidence, evidence_before, strict=True):
        np.testing.assert_allclose(new[kept], old[kept], atol=1e-5)
    # What starts within the kernels' reach ends where the noise lets it.
    close = np.abs(off).max(axis=1) < 0.15
    assert close.sum() > 1
    near = np.linalg.norm(np.asarray(found - TRUTH[None])[:, :2], axis=1) < 0.02
    assert near[close].all()
