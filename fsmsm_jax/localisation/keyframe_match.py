r"""A scan against keyframes: search widely, believe the prediction, fit finely.

Matching to the keyframes of a moment ago seldom fails for lack of precision, but by
falling into the wrong valley: the robot turned faster than anybody guessed; or, in a
corridor, where all places look alike, somebody who walks ahead looks like its end. So
the search is wide in heading, where valleys are narrow and scans tell them apart, and
timid otherwise. From the prediction, and from headings all around it, end points
descend onto the walls (graduated non-convexity, as in `alignment.fit`); what the
prediction's own descent finds is believed unless another one explains clearly more.

Then ranges are fitted in all keyframes at once. A ray that several of them know votes
once, all rays together at most as often as there are independent ones, and the
prediction votes with them: it decides where nothing else does.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.residuals import gauss_newton_step, geman_mcclure, scale_of
from fsmsm_jax.localisation.keyframes import KeyFrames, cast, look_up
from fsmsm_jax.sensing import Scan

__all__ = ["KeyframeMatch", "KeyframeMatchConfig", "difference", "match_keyframes"]

_NARROW = (0.3, 0.2, 0.15, 0.1, 0.1)  # [m] kernel scales of the prediction's descent
_WIDE = (1.0, 0.6, 0.4, 0.25, 0.15)  # [m] and of the others'
_WORST = 0.2  # [m] from the wall, beyond which an end point is merely wrong
_UNKNOWN = 0.5  # what an end point costs where no keyframe knows a wall; 1 is wrong
_SURPRISE = 1 / 30  # what it costs to be 1σ (and a bit) away from the prediction
_KERNEL = 4.0  # width of the fit's kernel in standard deviations, as in `fit_ranges`
_FINEST, _COARSEST = 0.005, 0.075  # [m] between which the standard deviation is taken
_SHARED = 0.5  # of the variance of a range that grows with its slant, as walls do
_AGREEING = 0.1  # [m], or the kernel's width: residuals of rays that agree


class KeyframeMatchConfig(eqx.Module):
    """How a scan is matched to keyframes."""

    rays: int = eqx.field(default=360, static=True)
    """The most that the fit uses of a scan."""
    scouts: int = eqx.field(default=90, static=True)
    """Those that the search uses."""
    headings: int = eqx.field(default=9, static=True)
    """To each side of the prediction, from which the search starts."""
    steps: int = eqx.field(default=5, static=True)
    """Of the fit."""
    spacing: ScalarLike = 0.14
    """Between those headings [rad]."""
    margin: ScalarLike = 0.1
    """Share of the rays that another start must explain better than the prediction."""
    votes: ScalarLike = 60.0
    """Independent rays that a scan is worth at most: neighbours err alike."""
    weakest: ScalarLike = 0.03
    """A direction with a larger standard deviation than this [m, or rad] is taken from
    the prediction, not from the scan."""

    def __check_init__(self):
        if min(self.rays, self.scouts, self.steps) < 1 or self.headings < 0:
            raise ValueError(
                "rays, scouts and steps count from 1 and headings from 0, got "
                f"{self.rays}, {self.scouts}, {self.steps} and {self.headings}"
            )


class KeyframeMatch(NamedTuple):
    """Where a scan was taken, and how well that explains it."""

    pose: Float[Array, "3"]
    """In the keyframes' common frame [m, m, rad]."""
    information: Float[Array, "3 3"]
    """Of the scan and the prediction together, [m, m, rad]⁻²."""
    believed: Float[Array, "3 3"]
    """What of the way from the prediction to the scan's own pose was gone: about the
    identity, but nought along a direction that is not measured."""
    agreement: Float[Array, ""]
    """Share of the echoes that agree with a keyframe."""
    known: Float[Array, ""]
    """Share of the echoes that fall on walls which some keyframe saw."""
    deviation: Float[Array, ""]
    """Standard deviation that the residuals show [m]."""


def match_keyframes(
    frames: KeyFrames,
    scan: Scan,
    predicted: Float[Array, "3"],
    spread: Float[Array, "3"],
    config: KeyframeMatchConfig = KeyframeMatchConfig(),
) -> KeyframeMatch:
    """The pose that explains a scan, not far from the prediction.

    Args:
        frames: what was seen a moment ago.
        scan: the new scan.
        predicted: where it should have been taken, in the keyframes' common frame
            [m, m, rad].
        spread: standard deviation of that [m, m, rad].
        config: settings.

    Note:
        Pure and of fixed length, for `jit` and `vmap`; it finds turns of up to
        `headings` × `spacing`, and half a metre. All finite, whatever the scan holds.
    """
    scouts = scan.thin(config.scouts)
    turns = np.arange(-config.headings, config.headings + 1)
    fan = jnp.zeros((turns.size, 3)).at[:, 2].set(turns * config.spacing)
    starts = jnp.concatenate([predicted[None], predicted[None] + fan])
    scales = jnp.asarray([_NARROW] + [_WIDE] * turns.size, predicted.dtype)
    descend = lambda start, scales: _descend(
        frames, scouts, start, scales, predicted, spread, config.votes
    )
    descended, costs = jax.vmap(descend)(starts, scales)
    best = jnp.argmin(costs.at[0].add(-jnp.asarray(config.margin)))
    most = scan if scan.ranges.size <= config.rays else scan.thin(config.rays)
    return _fit(frames, most, descended[best], predicted, spread, config)


def _descend(frames, scan, start, scales, predicted, spread, votes):
    """End points onto walls, and what the pose where they end costs, up to 1 a ray."""
    share = _share(scan, votes)

    def step(pose, scale):
        e, J, known = look_up(frames, scan, pose)
        w = jnp.where(known, geman_mcclure(e, scale) * share(known), 0.0)
        return _towards(pose, e, J, w / (scale / 4) ** 2, predicted, spread), None

    pose, _ = jax.lax.scan(step, start, scales)
    e, _, known = look_up(frames, scan, pose)
    wrong = jnp.min(jnp.where(known, jnp.minimum(jnp.abs(e) / _WORST, 1.0), 1.0), 0)
    wrong = jnp.where(jnp.any(known, 0), wrong, _UNKNOWN)
    cost = jnp.sum(jnp.where(scan.echo, wrong, 0.0)) / jnp.maximum(
        jnp.sum(scan.echo), 1
    )
    surprise = jnp.sum((difference(pose, predicted) / spread) ** 2)
    return pose, cost + _SURPRISE * jnp.log1p(0.5 * surprise)


def _fit(frames, scan, start, predicted, spread, config):
    """Robust Gauss-Newton on ranges in all keyframes, and what it leaves."""
    share = _share(scan, config.votes)

    def weigh(pose):
        e, J, known = cast(frames, scan, pose)
        slant2 = jnp.maximum(jnp.sum(J[..., :2] ** 2, axis=-1), 1.0)
        weight = 1 / (1 - _SHARED + _SHARED * slant2)
        scaled = e * jnp.sqrt(weight)
        sigma = scale_of(scaled.ravel(), known.ravel())
        sigma = jnp.clip(sigma, _FINEST, _COARSEST)
        w = geman_mcclure(scaled, _KERNEL * sigma) * weight * share(known) / sigma**2
        return e, J, jnp.where(known, w, 0.0), known, sigma

    def step(pose, _):
        e, J, w, _, _ = weigh(pose)
        return _towards(pose, e, J, w, predicted, spread), None

    pose, _ = jax.lax.scan(step, start, length=config.steps)
    e, J, w, known, sigma = weigh(pose)
    measured = jnp.einsum("kr,kri,krj->ij", w, J, J)
    believed = _believed(measured, config.weakest)
    pose = predicted + believed @ difference(pose, predicted)
    pose = pose.at[2].set(geometry.wrap(pose[2]))
    information = believed @ measured @ believed.T + jnp.diag(spread**-2)
    near = known & (jnp.abs(e) < jnp.maximum(_AGREEING, _KERNEL * sigma))
    echoes = jnp.maximum(jnp.sum(scan.echo), 1)
    share_of = lambda rays: jnp.sum(jnp.any(rays, axis=0)) / echoes
    return KeyframeMatch(
        pose, information, believed, share_of(near), share_of(known), sigma
    )


def _believed(information, weakest):
    """Projection onto what is measured; the rest stays as predicted.

    Noise in the outlines tells a little of everything. Believed scan after scan, that
    is a push along every corridor, and velocity adds it up.
    """
    known, axes = jnp.linalg.eigh(information)
    share = known**2 / (known**2 + jnp.asarray(weakest) ** -4)
    return (axes * share[None]) @ axes.T


def _share(scan, votes):
    """Weight of a ray in each keyframe that knows it, so that none votes twice."""
    each = jnp.minimum(votes / jnp.maximum(jnp.sum(scan.echo), 1), 1.0)
    return lambda known: each / jnp.maximum(jnp.sum(known, axis=0, keepdims=True), 1)


def _towards(pose, e, J, w, predicted, spread):
    """A Gauss-Newton step, the prediction being three residuals more."""
    return gauss_newton_step(
        pose,
        jnp.append(e.ravel(), difference(predicted, pose)),
        jnp.concatenate([J.reshape(-1, 3), jnp.eye(3, dtype=J.dtype)]),
        jnp.append(w.ravel(), spread**-2),
        0.0,
    )


def difference(pose: Float[Array, "3"], other: Float[Array, "3"]) -> Float[Array, "3"]:
    """What is to be added to the other to get the pose [m, m, rad]."""
    off = pose - other
    return off.at[2].set(geometry.wrap(off[2]))
