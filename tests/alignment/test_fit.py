"""`fit_ranges`: precise as physics allows, and no more sure than its map."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.evaluation.cases import as_worlds
from fsmsm_jax.evaluation.metrics import cramer_rao_bound, pose_errors
from fsmsm_jax.sensing import Scan, raycast
from fsmsm_jax.world import PolygonMap
from tests.worlds import CENTRE, l_room, star

RAYS, SIGMA, TRIALS = 360, 0.03, 64
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
FAR = jnp.asarray(100.0)


def scan_of(ranges, valid=None):
    valid = jnp.ones(RAYS, bool) if valid is None else valid
    return Scan(ranges, BEARINGS, valid, valid, FAR)


@partial(jax.jit, static_argnames="steps")
def fit(worlds, ranges, starts, steps=8, reach=np.inf):
    one = lambda world, r, start: fit_ranges(world, scan_of(r), start, steps, reach)[0]
    return jax.vmap(one)(worlds, ranges, starts)


def trial_worlds():
    worlds = [star(seed) for seed in range(TRIALS)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)


def trial(seed=0, off=(0.05, 0.05, 0.05)):
    rng = np.random.default_rng(seed)
    xy = CENTRE + rng.uniform(-0.2, 0.2, (TRIALS, 2))
    true = np.column_stack([xy, rng.uniform(-3, 3, TRIALS)])
    start = true + rng.uniform(-1, 1, true.shape) * off
    return jnp.asarray(true, float), jnp.asarray(start, float), rng


def test_reaches_the_cramer_rao_bound_without_being_told_the_noise():
    worlds = trial_worlds()
    true, start, rng = trial()
    clean = jax.vmap(raycast, (0, 0, None))(worlds, true, BEARINGS)
    noise = jnp.asarray(SIGMA * rng.standard_normal((TRIALS, RAYS)), float)
    found = fit(worlds, clean + noise, start)
    bound = jax.vmap(cramer_rao_bound, (0, 0, None, None, None))(
        worlds, true, BEARINGS, FAR, SIGMA
    )
    away = np.asarray(found - true)
    nees = np.einsum("ti,tij,tj->t", away, np.linalg.inv(np.asarray(bound)), away)
    # χ² with 3 · 64 degrees of freedom: mean 3 ± 0.31 (1σ) for an efficient estimate.
    # The weights estimated, the kernel and edges may cost a tenth.
    assert nees.mean() < 3 * 1.1 + 2 * 0.31
    assert nees.mean() > 3 - 3 * 0.31  # below the bound there is no honest result


def test_exact_without_noise():
    worlds = trial_worlds()
    true, start, _ = trial()
    clean = jax.vmap(raycast, (0, 0, None))(worlds, true, BEARINGS)
    position, turn = pose_errors(fit(worlds, clean, start), true)
    assert np.quantile(position, 0.9) < 1e-4
    assert np.quantile(turn, 0.9) < 1e-4


def test_blocked_rays_lose_their_vote():
    worlds = trial_worlds()
    true, start, rng = trial()
    clean = np.asarray(jax.vmap(raycast, (0, 0, None))(worlds, true, BEARINGS))
    blocked = rng.uniform(size=clean.shape) < 0.25
    ranges = np.where(blocked, clean * rng.uniform(0.1, 0.9, clean.shape), clean)
    ranges += SIGMA * rng.standard_normal(clean.shape)
    position, _ = pose_errors(fit(worlds, jnp.asarray(ranges, float), start), true)
    # 270 honest rays of σ: 1.2 times the bound of 360, about 3 mm; twice that is good.
    assert np.median(position) < 2 * SIGMA * np.sqrt(2 / 270)


def test_a_map_drawn_askew_is_weighted_by_slant():
    """Vertices off by 5 cm: rays that graze a wall feel it most and must count less.

    Compared with the same fit that thinks the map true (weights of 1).
    """
    worlds = trial_worlds()
    true, start, rng = trial()
    ranges = jax.vmap(raycast, (0, 0, None))(worlds, true, BEARINGS)
    ranges += jnp.asarray(0.005 * rng.standard_normal(ranges.shape), float)
    shift = 0.05 * rng.standard_normal(worlds.start.shape)
    askew = as_worlds(worlds.start + jnp.asarray(shift, float))
    position, _ = pose_errors(fit(askew, ranges, start), true)

    def plain(world, r, pose):
        """Gauss-Newton, unweighted but for a kernel of 0.2 m: the obvious version."""

        def step(pose, _):
            cast = lambda pose: raycast(world, pose, BEARINGS, FAR)
            e = r - cast(pose)
            J = jax.jacfwd(cast)(pose)
            w = (1 / (1 + (e / 0.2) ** 2) ** 2)[:, None]
            return pose + jnp.linalg.solve((J * w).T @ J, (J * w).T @ e), None

        return jax.lax.scan(step, pose, length=8)[0]

    unweighted, _ = pose_errors(jax.jit(jax.vmap(plain))(askew, ranges, start), true)
    assert np.mean(position) < 0.9 * np.mean(unweighted)


def test_reach_holds_the_pose_in_a_gap_that_got_narrower():
    """A wedge drawn narrower than it is would be slid out of, towards its wide end."""
    wedge = np.array([[-40, -0.5], [40, -3.5], [40, 3.5], [-40, 0.5]]) + CENTRE
    drawn = np.array([[-40, -0.4], [40, -3.4], [40, 3.4], [-40, 0.4]]) + CENTRE
    true = jnp.asarray([*CENTRE, 0.7], float)
    ranges = raycast(PolygonMap.from_outlines(wedge), true, BEARINGS, FAR)
    world = PolygonMap.from_outlines(drawn)
    free, _ = fit_ranges(world, scan_of(ranges), true, 8)
    held, _ = fit_ranges(world, scan_of(ranges), true, 8, 0.05)
    assert abs(float(free[0] - true[0])) > 0.1  # what the reach is for
    assert jnp.max(jnp.abs((held - true)[:2])) <= 0.05 + 1e-5


def test_no_rays_no_nan():
    start = jnp.asarray([*CENTRE, 0.4], float)
    nothing = scan_of(jnp.full(RAYS, 5.0), jnp.zeros(RAYS, bool))
    np.testing.assert_allclose(
        fit_ranges(l_room(), nothing, start, 3)[0], start, atol=1e-6
    )
