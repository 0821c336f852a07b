r"""One pose out of many particles, a better one by scan matching, and back again.

A filter's output is a weighted mean. Of *which* particles is the first question of the
thesis's chapter on particle filters: `select` takes all, those heavier than the mean,
the heaviest share, or the heaviest alone, and renormalises their weights (erratum E18).
The population itself stays as it is.

The second: what does scan matching add on top? The filter knows the pose to
centimetres; a match of one scan from there to millimetres (`correct`).

The third: should the filter be told (`feed_back`)? *Open*: no. *Hard*: it starts
again around the match, and forgets all else. *Soft*: the match joins as one particle
(soft_1), or as a fixed share q of the population (soft_p, the thesis's proposal), so
that a wrong match is outvoted and a right one takes over by its weight.

Reference: thesis §4, algorithms III and IV.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import truncated_caer_per_ray
from fsmsm_jax.alignment.fast import FastConfig, fast_match
from fsmsm_jax.sensing import Scan, panorama, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = [
    "Feedback",
    "ScanMatching",
    "Selection",
    "correct",
    "feed_back",
    "gaussian_cloud",
    "select",
    "weighted_pose",
]

_MANNERS = ("open", "hard", "soft_1", "soft_p")
_WHOLE = 1e-4  # ⌊x⌋ of a product that should be whole but is not in float32


class Selection(eqx.Module):
    """Which particles the output is the mean of."""

    manner: str = eqx.field(default="absolute", static=True)
    """"absolute": the heaviest share; "relative": those heavier than the mean."""
    fraction: ScalarLike = 1.0
    """That share, 0 for the heaviest alone; of no meaning if relative."""

    def __check_init__(self):
        if self.manner not in ("absolute", "relative"):
            raise ValueError(
                f"manner must be 'absolute' or 'relative', got {self.manner!r}"
            )


def select(
    log_weights: Float[Array, "particles"],
    count: Int[Array, ""],
    selection: Selection = Selection(),
) -> Float[Array, "particles"]:
    """Weights over the selected particles, which sum to 1; 0 for the others.

    Args:
        log_weights: of the particles [nats], of any sum.
        count: how many there are: the first so many.
        selection: all, by share or by mean. At least the heaviest is selected; if none
            is heavier than the mean, they are equal and all are.

    Reference:
        Algorithm III of the thesis, weights renormalised (erratum E18).
    """
    alive = jnp.arange(log_weights.size) < count
    weights = _weights(log_weights, alive)
    if selection.manner == "relative":
        kept = weights > jnp.sum(weights) / count
        kept = jnp.where(jnp.any(kept), kept, alive)
    else:
        wanted = jnp.floor(selection.fraction * count + _WHOLE)
        order = jnp.argsort(jnp.where(alive, -log_weights, jnp.inf), stable=True)
        rank = jnp.zeros(order.size, int).at[order].set(jnp.arange(order.size))
        kept = alive & (rank < jnp.maximum(wanted, 1))
    weights = jnp.where(kept, weights, 0.0)
    return weights / jnp.sum(weights)


def _weights(log_weights, alive):
    """Of the living, the heaviest being 1; all 1 if no weight is left."""
    top = jnp.max(jnp.where(alive, log_weights, -jnp.inf))
    weights = jnp.where(jnp.isfinite(top), jnp.exp(log_weights - top), 1.0)
    return jnp.where(alive, weights, 0.0)


def weighted_pose(
    poses: Float[Array, "particles 3"], weights: Float[Array, "particles"]
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Mean of poses [m, m, rad], headings on the circle, and covariance [m, m, rad]².

    Args:
        poses: in one frame.
        weights: not negative, of sum 1.
    """
    # About the heaviest: far from the origin squares of coordinates lose their digits.
    centre = poses[jnp.argmax(weights)]
    off = poses - centre[None]
    turn = off[:, 2]
    mean_turn = jnp.arctan2(weights @ jnp.sin(turn), weights @ jnp.cos(turn))
    mean = jnp.append(weights @ off[:, :2], mean_turn)
    left = off - mean[None]
    left = left.at[:, 2].set(geometry.wrap(left[:, 2]))
    pose = centre + mean
    return pose.at[2].set(geometry.wrap(pose[2])), (left * weights[:, None]).T @ left


class ScanMatching(eqx.Module):
    """How the output is corrected by its scan."""

    rays: int = eqx.field(default=180, static=True)
    """Rays that are matched, spread evenly over the informative ones."""
    match: FastConfig = FastConfig(headings=2, kept=1, looks=1, finish=3)
    """How; a filter's output needs less of a search than a guess."""
    cap: ScalarLike = 0.5
    """Rays that differ by more count just this much when poses are compared [m]."""

    def __check_init__(self):
        if self.rays < 8:
            raise ValueError(f"a match takes at least 8 rays, got {self.rays}")


def correct(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    config: ScanMatching = ScanMatching(),
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """The pose that a filter puts out, matched by its scan: sm2 of the thesis.

    Args:
        world: the map.
        scan: one scan.
        pose: the output [m, m, rad].
        config: settings.

    Returns:
        The corrected pose and True; the output itself and False where the match leaves
        the box of `config.match`, the map, or explains the scan worse (truncated CAER
        per ray) than the output does.
    """
    scan = scan.thin(config.rays)
    found, _ = fast_match(world, scan, panorama(scan, config.rays), pose, config.match)

    def unlike(pose):
        virtual = raycast(world, pose, scan.bearings, scan.range_max)
        return truncated_caer_per_ray(
            scan.ranges, virtual, jnp.asarray(config.cap), scan.valid
        )

    away = jnp.abs(found - pose)
    metres, radians = config.match.box
    near = (away[0] <= metres) & (away[1] <= metres)
    near &= jnp.abs(geometry.wrap(away[2])) <= radians
    good = near & world.contains(found[:2]) & (unlike(found) <= unlike(pose))
    good &= jnp.any(scan.echo)
    return jnp.where(good, found, pose), good


class Feedback(eqx.Module):
    """What the filter is told of the corrected pose."""

    manner: str = eqx.field(default="open", static=True)
    """"open", "hard", "soft_1" or "soft_p"."""
    share: ScalarLike = 0.5
    """q of soft_p: the share of the population that is clones; 0 < q < 1."""
    clone_weight: ScalarLike = 1.0
    """Weight of a clone, in units of `clone_unit`."""
    clone_unit: str = eqx.field(default="mean", static=True)
    """"mean": the mean weight; "sum": the sum of all weights.

    The thesis leaves the weight open; its program says `feedback_particle_weight: 1.0`.
    In amcl 1 is what a particle weighs when it has been drawn, that is as much as any
    other, hence the default. Once amcl has normalised, weights sum to 1, and a clone of
    weight 1 outweighs everybody: "sum".
    """
    spread: tuple[ScalarLike, ScalarLike] = (0.5, 0.26180)
    """Of hard: standard deviations of the new population [m, rad], as at the start."""

    def __check_init__(self):
        if self.manner not in _MANNERS:
            raise ValueError(f"manner must be one of {_MANNERS}, got {self.manner!r}")
        if self.clone_unit not in ("mean", "sum"):
            raise ValueError(
                f"clone_unit must be 'mean' or 'sum', got {self.clone_unit!r}"
            )


def feed_back(
    key: PRNGKeyArray,
    poses: Float[Array, "particles 3"],
    log_weights: Float[Array, "particles"],
    count: Int[Array, ""],
    pose: Float[Array, "3"],
    feedback: Feedback,
) -> tuple[Float[Array, "particles 3"], Float[Array, "particles"], Int[Array, ""]]:
    """The population after it was told of a pose.

    With N the room for particles, |P| their count and q the share of clones, soft_p
    deletes the ⌊|P| − (1 − q)N⌋ lightest, if that is positive, and adds ⌊q/(1 − q)·|P|⌋
    clones, at most ⌊qN⌋; of a full population it deletes as many as it adds.

    Args:
        key: of hard's new population.
        poses: of the particles [m, m, rad], N of them.
        log_weights: theirs [nats]; −inf beyond `count`.
        count: how many there are: the first so many.
        pose: what they are told, the corrected output [m, m, rad].
        feedback: how.

    Returns:
        Poses, log-weights and count, as they came in; log-weights sum to 1 as weights.

    Reference:
        Algorithm IV of the thesis.
    """
    room = len(poses)
    if feedback.manner == "open":
        return poses, log_weights, count
    if feedback.manner == "hard":
        metres, radians = feedback.spread
        sigmas = jnp.asarray([metres, metres, radians], poses.dtype)
        cloud = gaussian_cloud(key, pose, jnp.diag(sigmas**2), room)
        even = jnp.full(room, -jnp.log(float(room)), poses.dtype)
        return cloud, even, jnp.asarray(room, count.dtype)

    deleted, added = _exchange(count, room, feedback)
    alive = jnp.arange(room) < count
    lightest_last = jnp.argsort(jnp.where(alive, -log_weights, jnp.inf), stable=True)
    index = jnp.arange(room)
    kept = index < count - deleted
    after = count - deleted + added
    clone = ~kept & (index < after)
    total = jax.nn.logsumexp(jnp.where(alive, log_weights, -jnp.inf))
    unit = total - jnp.log(count) if feedback.clone_unit == "mean" else total
    of_clone = unit + jnp.log(jnp.asarray(feedback.clone_weight, poses.dtype))
    poses = jnp.where(clone[:, None], pose[None], poses[lightest_last])
    log_weights = jnp.where(
        kept, log_weights[lightest_last], jnp.where(clone, of_clone, -jnp.inf)
    )
    log_weights = log_weights - jax.nn.logsumexp(log_weights)
    return poses, log_weights, after.astype(count.dtype)


def _exchange(count, room, feedback):
    """How many of the lightest go, and how many clones come."""
    if feedback.manner == "soft_1":
        return jnp.where(count == room, 1, 0), jnp.ones_like(count)
    q = feedback.share
    whole = lambda x: jnp.floor(x + _WHOLE).astype(int)
    clones = whole(q * room)
    few = count <= (1 - q) * room + _WHOLE
    added = jnp.where(few, whole(q / (1 - q) * count), clones)
    deleted = jnp.where(few, 0, whole(count - (1 - q) * room))
    deleted = jnp.where(count == room, clones, deleted)
    # Rounding down twice must not overfill the room.
    return deleted, jnp.minimum(added, room - (count - deleted))


def gaussian_cloud(
    key: PRNGKeyArray,
    pose: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    count: int,
) -> Float[Array, "count 3"]:
    """Poses [m, m, rad] drawn about one; a singular covariance is allowed."""
    size, axes = jnp.linalg.eigh(covariance)
    scaled = axes * jnp.sqrt(jnp.maximum(size, 0))[None]
    noise = jax.random.normal(key, (count, 3), pose.dtype) @ scaled.T
    poses = pose[None] + noise
    return poses.at[:, 2].set(geometry.wrap(poses[:, 2]))
