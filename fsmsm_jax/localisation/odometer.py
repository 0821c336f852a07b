r"""How did I move? Odometry from scans alone: no wheels, no map.

A scan can be matched to the scan before, and the motions added up; but then each error
stays for good, and even a robot at rest strays. So scans are matched to *keyframes*,
the last few of them at once (`keyframes`): as long as the view is shared nothing adds
up, and what one keyframe has wrong, the others outvote. Each scan is one step:

1. **predict**: the robot goes on as it went;
2. **match**: where the scan fits the keyframes (`keyframe_match`). In directions that
   nothing measures, as along a bare corridor, the prediction holds;
3. **keep**: where the robot has moved on, or turned, or sees too much that is new, the
   scan becomes the newest keyframe, and the oldest is forgotten.

`init` and `step` are pure and of fixed shapes; `run` is `lax.scan` over a log.
`lidar_odometry` checks its input and takes a log of any length.

Reference: scan-to-scan matching with the reference scan's polygon as the world is FSM,
by the author of FSMSM; keyframes and the joint fit are ours.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.localisation.keyframe_match import (
    KeyframeMatchConfig,
    difference,
    match_keyframes,
)
from fsmsm_jax.localisation.keyframes import KeyFrames, none_yet, with_keyframe
from fsmsm_jax.sensing import Scan, panorama

__all__ = [
    "LidarOdometryConfig",
    "OdometryInfo",
    "OdometryState",
    "init",
    "run",
    "step",
]


class LidarOdometryConfig(eqx.Module):
    """How scans are matched, and when one is kept."""

    keyframes: int = eqx.field(default=5, static=True)
    """Keyframes that a scan is matched to."""
    rays: int = eqx.field(default=360, static=True)
    """Of a keyframe's outline."""
    acceleration: tuple[ScalarLike, ScalarLike] = (0.1, 0.15)
    """How far a motion differs from the last one, 1σ [m, rad]."""
    match: KeyframeMatchConfig = KeyframeMatchConfig()
    """How a scan is matched to them."""
    apart: tuple[ScalarLike, ScalarLike] = (0.4, 0.5)
    """Distance or angle from the newest keyframe at which a new one is due [m, rad]."""
    shared: ScalarLike = 0.75
    """One is due at a quarter of that if fewer rays agree, as a share."""
    least: ScalarLike = 0.3
    """Share of the rays that agree in a match that is believed."""
    fewest: ScalarLike = 20
    """Echoes; a scan with fewer is skipped."""

    def __check_init__(self):
        if self.keyframes < 1 or self.rays < 8:
            raise ValueError(
                "expected at least 1 keyframe of at least 8 rays, got "
                f"{self.keyframes} of {self.rays}"
            )


class OdometryState(NamedTuple):
    """All that is kept from scan to scan."""

    pose: Float[Array, "3"]
    """Of the lidar at the last scan, in its frame at the first one [m, m, rad]."""
    motion: Float[Array, "3"]
    """The last motion: the pose in the frame of the one before [m, m, rad]."""
    frames: KeyFrames
    """What the last keyframes saw, and from where."""
    covariance: Float[Array, "3 3"]
    """Of the newest keyframe's pose [m, m, rad]²."""


class OdometryInfo(NamedTuple):
    """What one step found; what one would plot."""

    pose: Float[Array, "3"]
    """Of the lidar, in its frame at the first scan [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Of the pose [m, m, rad]²: of the match, and of the keyframes it goes back on."""
    predicted: Float[Array, "3"]
    """Where the lidar was expected [m, m, rad]."""
    matched: Bool[Array, ""]
    """Whether the scan had a say; without, the pose is the prediction."""
    enough: Bool[Array, ""]
    """Whether the scan had enough echoes to be asked."""
    keyframe: Bool[Array, ""]
    """Whether it was kept as a keyframe."""
    agreement: Float[Array, ""]
    """Share of the echoes that agree with a keyframe."""
    known: Float[Array, ""]
    """Share of the echoes that fall on walls which some keyframe saw."""
    deviation: Float[Array, ""]
    """Standard deviation that the residuals show [m]."""


def init(config: LidarOdometryConfig = LidarOdometryConfig()) -> OdometryState:
    """At rest at the origin; the first scan that can be used will be a keyframe."""
    frames = none_yet(config.keyframes, config.rays)
    nowhere = jnp.zeros(3)
    return OdometryState(nowhere, nowhere, frames, jnp.zeros((3, 3)))


@jax.jit
def step(
    state: OdometryState,
    scan: Scan,
    config: LidarOdometryConfig = LidarOdometryConfig(),
) -> tuple[OdometryState, OdometryInfo]:
    """One scan on.

    Args:
        state: what the last step left, or `init(config)`.
        scan: the new scan, of any field of view; dirty rays are masked in it.
        config: settings.

    Returns:
        The next state, and what was found. All finite, whatever the scan holds.
    """
    predicted = geometry.compose(state.pose, state.motion)
    away, turn = config.acceleration
    spread = jnp.array([away, away, turn], predicted.dtype)
    found = match_keyframes(state.frames, scan, predicted, spread, config.match)

    enough = jnp.sum(scan.echo) >= config.fewest
    first = state.frames.taken == 0
    matched = enough & ~first & (found.agreement >= config.least)
    pose = jnp.where(matched, found.pose, jnp.where(first, state.pose, predicted))
    # The velocity is slower to believe what is hardly measured than the pose.
    onward = predicted + found.believed @ difference(pose, predicted)
    motion = geometry.between(state.pose, jnp.where(matched, onward, pose))
    information = jnp.where(matched, found.information, jnp.diag(spread**-2))
    covariance = _since(state, pose) + jnp.where(first, 0.0, _inverse(information))

    away = geometry.between(state.frames.newest, pose)
    far, turned = config.apart
    way = jnp.maximum(jnp.hypot(away[0], away[1]) / far, jnp.abs(away[2]) / turned)
    new = (way > 1) | ((way > 0.25) & (found.agreement < config.shared))
    keyframe = enough & (first | ~matched | new)
    frames = jax.lax.cond(
        keyframe,
        lambda: with_keyframe(state.frames, panorama(scan, config.rays), pose),
        lambda: state.frames,
    )
    kept = jnp.where(keyframe, covariance, state.covariance)
    info = OdometryInfo(
        pose=pose,
        covariance=covariance,
        predicted=predicted,
        matched=matched,
        enough=enough,
        keyframe=keyframe,
        agreement=found.agreement,
        known=found.known,
        deviation=found.deviation,
    )
    return OdometryState(pose, motion, frames, kept), info


@jax.jit
def run(
    state: OdometryState,
    scans: Scan,
    config: LidarOdometryConfig = LidarOdometryConfig(),
) -> tuple[OdometryState, OdometryInfo]:
    """`step` through scans stacked along a leading axis, as one program."""
    return jax.lax.scan(lambda state, scan: step(state, scan, config), state, scans)


def _since(state, pose):
    """Covariance of the newest keyframe, carried on to the pose."""
    dx, dy, _ = pose - state.frames.newest
    F = jnp.eye(3, dtype=pose.dtype).at[0, 2].set(-dy).at[1, 2].set(dx)
    return F @ state.covariance @ F.T


def _inverse(information):
    """Of a 3 × 3, scaled so that metres and radians do not spoil it."""
    scale = 1 / jnp.sqrt(jnp.diagonal(information))
    scale = scale[:, None] * scale[None]
    inverse = jnp.linalg.inv(information * scale)
    return 0.5 * (inverse + inverse.T) * scale
