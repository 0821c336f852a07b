"""Two scans fitted to each other: residuals, their slope, and neither is the truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.alignment import View, fit_views, view_covariance, view_residuals
from fsmsm_jax.sensing import Scan, raycast
from tests.alignment.simulated import errors
from tests.worlds import CENTRE, l_room

RAYS, FAR = 180, 20.0
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
POSE = jnp.asarray([*(CENTRE + [0.4, -0.3]), 0.6], float)
MOTION = jnp.array([0.15, -0.1, 0.4])

cast = jax.jit(lambda pose: raycast(l_room(), pose, BEARINGS, FAR))
view_of = jax.jit(View.of, static_argnums=1)
residuals = jax.jit(view_residuals)
fit = jax.jit(fit_views, static_argnums=3)
spread = jax.jit(view_covariance)


def take(pose, sigma=0.0, seed=0, half_view=np.pi):
    """A noisy scan of the L-room, as a view."""
    z = np.random.default_rng(seed).normal(size=RAYS)
    ranges = cast(jnp.asarray(pose, float)) + sigma * jnp.asarray(z, float)
    seen = jnp.abs(BEARINGS) <= half_view
    limit = jnp.asarray(FAR)
    return view_of(
        Scan(jnp.where(seen, ranges, FAR), BEARINGS, seen, seen, limit), RAYS
    )


def pair(sigma=0.0, half_view=np.pi):
    there = geometry.compose(POSE, MOTION)
    return take(POSE, sigma, 1, half_view), take(there, sigma, 2, half_view)


def test_at_the_true_pose_nothing_is_left_without_noise():
    for half_view in (np.pi, np.pi / 2):
        reference, view = pair(half_view=half_view)
        e, _, _, known = residuals(reference, view.scan, MOTION)
        e, known = np.asarray(e), np.asarray(known)
        assert known.mean() > (0.85 if half_view > 3 else 0.35)
        # Chords are exact along walls, to rounding; corners and edges lie between rays.
        assert np.mean(np.abs(e[known]) < 1e-4) > 0.9
        assert np.median(np.abs(e[known])) < 1e-5


def test_derivative_is_that_of_the_residual():
    reference, view = pair()
    e, J, _, known = residuals(reference, view.scan, MOTION)
    step = 2e-3  # rounding of 1e-6 m over it: 5e-4; the curvature's share is less
    columns = []
    for d in step * jnp.eye(3):
        up, _, _, known_up = residuals(reference, view.scan, MOTION + d)
        down, _, _, known_down = residuals(reference, view.scan, MOTION - d)
        columns.append((up - down) / (2 * step))
        known &= known_up & known_down
    numeric = -np.stack(columns, axis=-1)[np.asarray(known)]
    error = np.abs(np.asarray(J)[np.asarray(known)] - numeric)
    scale = 1 + np.abs(numeric)
    # Beside corners the smoothed slope is another than the chord's.
    assert np.mean((error < 0.01 * scale).all(axis=1)) > 0.9
    assert np.median(error) < 2e-3


@pytest.mark.parametrize(("sigma", "metres"), [(0.0, 2e-4), (0.02, 0.008)])
def test_fit_finds_the_motion(sigma, metres):
    """Without noise to rounding and corners; with it to 3 σ of the bound (2.5 mm)."""
    start = MOTION + jnp.array([0.04, -0.03, 0.03])
    found = fit(*pair(sigma), start, 8)
    off, turn = errors(found, MOTION)
    assert off < metres
    assert turn < metres


def test_the_other_way_round_it_is_the_inverse():
    """Both scans are laid upon each other, so that there is no first."""
    reference, view = pair(0.02)
    start = MOTION + jnp.array([0.02, -0.02, 0.02])
    there = fit(reference, view, start, 8)
    back = fit(view, reference, geometry.inverse(start), 8)
    off, turn = errors(geometry.inverse(back), there)
    # Steps are damped in another frame; at rest after 8 of them to a twentieth of σ.
    assert off < 2e-4
    assert turn < 1e-4
    A = np.asarray(jax.jacfwd(geometry.inverse)(there))
    covariance = A @ np.asarray(spread(reference, view, there)) @ A.T
    np.testing.assert_allclose(
        spread(view, reference, back), covariance, rtol=0.05, atol=1e-8
    )


def test_turning_both_sensors_turns_the_motion():
    """Rays are rolled, so that the very same noise is seen from turned sensors."""
    sigma, rays = 0.02, 25
    angle = rays * 2 * np.pi / RAYS

    def turned(view):
        roll = lambda a: jnp.roll(a, -rays) if a.ndim else a
        scan = jax.tree.map(roll, view.scan)
        return view_of(eqx.tree_at(lambda s: s.bearings, scan, BEARINGS), RAYS)

    reference, view = pair(sigma)
    straight = fit(reference, view, MOTION, 8)
    c, s = np.cos(angle), np.sin(angle)
    turn = lambda p: jnp.stack([c * p[0] + s * p[1], c * p[1] - s * p[0], p[2]])
    found = fit(turned(reference), turned(view), turn(MOTION), 8)
    off, angle = errors(found, turn(straight))
    assert off < 3e-4  # windows on the verge of being believed (test_surfaces)
    assert angle < 2e-4


def test_the_answer_stays_within_reach():
    reference, view = pair()
    start = MOTION + jnp.array([0.3, 0.3, 0.0])
    found = fit(reference, view, start, 8, 0.1)
    assert np.abs(np.asarray(found - start))[:2].max() <= 0.1 + 1e-6


def test_covariance_grows_with_the_noise_and_has_a_floor():
    trace = lambda sigma: float(jnp.trace(spread(*pair(sigma), MOTION)[:2, :2]))
    none, little, more = trace(0.0), trace(0.01), trace(0.04)
    assert none > 0  # 5 mm a ray are taken for granted
    assert little / none == pytest.approx(4, rel=0.5)  # (0.01 / 0.005)²
    assert more / little == pytest.approx(16, rel=0.5)


def test_a_circle_leaves_the_heading_open():
    r = jnp.full(RAYS, 2.0) + 0.01 * jnp.asarray(
        np.random.default_rng(0).normal(size=RAYS), float
    )
    every = jnp.ones(RAYS, bool)
    round_about = view_of(Scan(r, BEARINGS, every, every, jnp.asarray(FAR)), RAYS)
    covariance = np.asarray(spread(round_about, round_about, jnp.zeros(3)))
    assert np.sqrt(covariance[0, 0]) < 0.01
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_without_anything_in_common_the_pose_stays_and_nothing_is_known():
    nothing = take(POSE, half_view=-1.0)
    reference, _ = pair()
    np.testing.assert_allclose(fit(reference, nothing, MOTION, 8), MOTION, atol=1e-6)
    covariance = np.asarray(spread(reference, nothing, MOTION))
    # The prior of what no ray measures: 10 m, 10 m and π.
    np.testing.assert_allclose(np.diag(covariance), [100, 100, np.pi**2], rtol=1e-3)


def test_dtypes_are_kept_under_x64():
    """Values of float64 are those of float32: a compile for it would buy no more."""
    reference, view = pair(0.02)
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            to = lambda a, d=dtype: a.astype(d) if a.dtype == np.float32 else a
            scans = jax.tree.map(to, (reference.scan, view.scan))

            def both(one, other, pose):
                views = View.of(one, RAYS), View.of(other, RAYS)
                return fit_views(*views, pose, 8), view_covariance(*views, pose)

            found = jax.eval_shape(both, *scans, jnp.zeros(3, dtype))
            assert {leaf.dtype for leaf in found} == {np.dtype(dtype)}
