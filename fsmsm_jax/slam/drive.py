"""What a landmark SLAM filter is fed: controls in between, detections at each step.

A drive is cut at the moments at which landmarks are looked for. One step holds the
controls since the last look, then what was detected; a step without detections only
moves. Steps are padded to equal shapes, so that `jax.lax.scan` runs a drive and
`jax.vmap` many of them: a control of zero duration moves nothing, and a detection that
is not `valid` is none.

Real logs are dirty. `tidied` says what is made of them: an unusable control repeats
the one before it (a car goes on as it went), and a detection that is no place on the
ground (nothing, infinite, zero range) is none.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

__all__ = ["Drive", "Numbers", "seen", "tidied"]

Numbers = Array | np.ndarray


class Drive(NamedTuple):
    """Controls and detections of one drive, or of many with leading axes."""

    controls: Float[Numbers, "*drives steps controls 3"]
    """Speed [m/s], steering [rad] (or turn rate [rad/s]), and how long [s]."""
    detections: Float[Numbers, "*drives steps detections 2"]
    """Range [m] and bearing [rad], 0 ahead and counter-clockwise."""
    valid: Bool[Numbers, "*drives steps detections"]
    """Which detections there are."""
    ids: Int[Numbers, "*drives steps detections"]
    """Which landmark was detected, from 0; −1 where nobody knows."""


def tidied(
    controls: Shaped[np.ndarray, "..."],
    detections: Shaped[np.ndarray, "..."],
    valid: Shaped[np.ndarray, "..."] | None = None,
    ids: Shaped[np.ndarray, "..."] | None = None,
) -> Drive:
    """A drive of what a log says, safe to filter.

    Args:
        controls: [steps, controls, 3], speed [m/s], steering [rad] and duration [s] of
            each. Speeds and steerings that are not finite repeat the last that was, or
            are zero; durations that are not finite are zero.
        detections: [steps, detections, 2], range [m] and bearing [rad]. What is not
            finite, or not farther than zero, is no detection.
        valid: [steps, detections], which there are; by default all that can be.
        ids: [steps, detections], which landmark each is; by default unknown (−1).

    Raises:
        ValueError: the shapes do not fit, a duration is negative, or an id is below −1.

    Example:
        >>> controls = np.array([[[3.0, 0.1, 0.2]], [[3.0, np.nan, 0.2]]])
        >>> seen = np.array([[[0.0, 1.0]], [[4.0, 7.0]]])
        >>> drive = tidied(controls, seen)
        >>> drive.controls[1, 0].tolist(), drive.valid[:, 0].tolist()
        ([3.0, 0.1, 0.2], [False, True])
    """
    controls, detections = np.asarray(controls, float), np.asarray(detections, float)
    if controls.ndim != 3 or controls.shape[-1] != 3:
        raise ValueError(
            "expected controls of shape [steps, controls, 3] (speed, steering, "
            f"duration), got {controls.shape}"
        )
    if detections.ndim != 3 or detections.shape[-1] != 2:
        raise ValueError(
            "expected detections of shape [steps, detections, 2] (range, bearing), got "
            f"{detections.shape}"
        )
    known = np.ones(detections.shape[:2], bool) if valid is None else np.array(valid)
    ids = np.full(detections.shape[:2], -1) if ids is None else np.array(ids)
    steps = {len(controls), len(detections), len(known), len(ids)}
    if len(steps) > 1 or not known.shape == ids.shape == detections.shape[:2]:
        raise ValueError(
            "expected as many steps of controls and detections, got "
            f"{controls.shape}, {detections.shape}, {known.shape} and {ids.shape}"
        )
    if np.any(controls[..., 2] < 0):
        raise ValueError(
            f"{np.sum(controls[..., 2] < 0)} controls last less than zero seconds: "
            "bring them in the order of their times"
        )
    if np.any(ids < -1):
        raise ValueError(f"expected ids from 0, or -1 for unknown, got {ids.min()}")

    usable = np.isfinite(detections).all(axis=-1) & (detections[..., 0] > 0)
    known = known.astype(bool) & usable
    detections = np.where(known[..., None], detections, [1.0, 0.0])
    bearing = detections[..., 1]
    detections[..., 1] = np.arctan2(np.sin(bearing), np.cos(bearing))
    return Drive(_held(controls), detections, known, ids.astype(int))


def seen(frame: Drive) -> Drive:
    """One step whose detections are all places on the ground, the others not valid.

    What `tidied` does, for steps that were made by hand.
    """
    if not len(frame.valid):  # no columns at all: one that is empty, to take maxima of
        none = jnp.zeros((1, 2)), jnp.zeros(1, bool), jnp.full(1, -1)
        frame = Drive(frame.controls, *none)
    real = jnp.all(jnp.isfinite(frame.detections), axis=1) & (
        frame.detections[:, 0] > 0
    )
    valid = frame.valid & real
    harmless = jnp.array([1.0, 0.0])
    detections = jnp.where(valid[:, None], frame.detections, harmless)
    return frame._replace(detections=detections, valid=valid)


def _held(controls):
    """Unusable speeds and steerings replaced by the last usable ones."""
    lasting = np.where(np.isfinite(controls[..., 2]), controls[..., 2], 0.0)
    rows = controls[..., :2].reshape(-1, 2)
    usable = np.isfinite(rows).all(axis=1) & (lasting.ravel() > 0)
    last = np.maximum.accumulate(np.where(usable, np.arange(len(rows)), -1))
    rows = np.where((last >= 0)[:, None], rows[last], 0.0)
    moves = rows.reshape(*controls.shape[:2], 2)
    return np.concatenate([moves, lasting[..., None]], axis=-1)
