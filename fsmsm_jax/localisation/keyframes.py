r"""The last few scans as a map: what each saw, from where, and how a new one fits.

A scan is a world (`sensing.seen_space`): walls where it met something, veils where it
saw no farther. A robot without a map keeps the worlds of its last K *keyframes*, each
in a frame of its own, at a pose of its own, and with its own veils: what one could not
see does not count against another. Two questions are asked of them all at once.

- *How far are the end points from the walls?* Seen from where a keyframe was taken, its
  outline is a function of the bearing, so the wall that an end point belongs to is
  looked up, not searched for: cheap enough for dozens of guesses, and good from afar.
- *What would be seen from here?* Rays cast in each world, with the exact derivative:
  the sensor's own measurement, and right where things hide each other.

Both give residuals e ≈ J δ of all rays in all keyframes, δ being a change of the pose.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.sensing import Scan, raycast_with_jacobian, seen_space
from fsmsm_jax.world import PolygonMap

__all__ = ["KeyFrames", "cast", "look_up", "none_yet", "with_keyframe"]

_BEHIND = 0.5  # [m] seen where no ray points, or a step back would leave the seen space
_TINY = 1e-9  # [m]

Residuals = tuple[
    Float[Array, "keyframes rays"],
    Float[Array, "keyframes rays 3"],
    Bool[Array, "keyframes rays"],
]


class KeyFrames(NamedTuple):
    """K worlds of N walls or veils; those not filled yet have no walls."""

    outlines: PolygonMap
    """Stacked along a leading axis, each in its keyframe's frame."""
    poses: Float[Array, "keyframes 3"]
    """Of the keyframes in the odometry's frame [m, m, rad]."""
    taken: Int[Array, ""]
    """How many there have been; the newest is at (taken − 1) mod K."""

    @property
    def newest(self) -> Float[Array, "3"]:
        """Pose of the newest keyframe [m, m, rad]."""
        return self.poses[(self.taken - 1) % len(self.poses)]


def none_yet(keyframes: int, rays: int) -> KeyFrames:
    """Room for so many keyframes of so many rays each."""
    nowhere = jnp.zeros((keyframes, rays, 2))
    nothing = jnp.zeros((keyframes, rays), bool)
    outlines = jax.vmap(PolygonMap)(nowhere, nowhere, nothing)
    return KeyFrames(outlines, jnp.zeros((keyframes, 3)), jnp.zeros((), int))


def with_keyframe(
    frames: KeyFrames, panorama: Scan, pose: Float[Array, "3"]
) -> KeyFrames:
    """One more keyframe; it takes the place of the oldest.

    Args:
        frames: those so far.
        panorama: the scan as N equiangular rays (`sensing.panorama`), N as in `frames`.
        pose: where it was taken, in the odometry's frame [m, m, rad].
    """
    ahead = jnp.where(panorama.valid, panorama.ranges, _BEHIND)
    outline = seen_space(
        Scan(
            ranges=ahead,
            bearings=panorama.bearings,
            valid=jnp.ones_like(panorama.valid),
            echo=panorama.echo,
            range_max=panorama.range_max,
        )
    )
    place = frames.taken % len(frames.poses)
    put = lambda old, new: old.at[place].set(new)
    outlines = jax.tree.map(put, frames.outlines, outline)
    return KeyFrames(outlines, put(frames.poses, pose), frames.taken + 1)


def look_up(frames: KeyFrames, scan: Scan, pose: Float[Array, "3"]) -> Residuals:
    """How far behind the walls of the keyframes the end points lie.

    Args:
        frames: the keyframes.
        scan: the new scan; its echoes count.
        pose: where it may have been taken, in the odometry's frame [m, m, rad].

    Returns:
        Depths e of the end points behind the walls [m], along their normals; J, with
        e ≈ J δ for a small change δ of the pose; and which are known: an echo that lies
        in the direction of a wall, seen from the keyframe.
    """
    points = scan.points
    back = points[:, ::-1] * jnp.array([-1.0, 1.0], points.dtype)[None]  # turned by 90°

    def one(outline, key):
        rays = len(outline.start)
        relative = geometry.between(key, pose)
        x, y = geometry.transform_points(relative, points).T
        place = (jnp.arctan2(y, x) + jnp.pi) * (rays / (2 * jnp.pi))
        index = jnp.clip(jnp.floor(place).astype(int), 0, rays - 1)
        start, end = outline.start[index], outline.end[index]
        along = end - start
        length = jnp.hypot(along[:, 0], along[:, 1]) + _TINY
        nx, ny = -along[:, 1] / length, along[:, 0] / length  # facing the keyframe
        ahead = nx * (x - start[:, 0]) + ny * (y - start[:, 1])
        c, s = jnp.cos(key[2]), jnp.sin(key[2])
        normal = jnp.stack([c * nx - s * ny, s * nx + c * ny], axis=-1)
        arm = geometry.transform_points(pose.at[:2].set(0.0), back)
        turn = jnp.sum(normal * arm, axis=1, keepdims=True)
        J = jnp.concatenate([normal, turn], axis=1)
        return -ahead, J, outline.solid[index] & scan.echo

    return jax.vmap(one)(frames.outlines, frames.poses)


def cast(frames: KeyFrames, scan: Scan, pose: Float[Array, "3"]) -> Residuals:
    """Real minus virtual ranges in each keyframe's world.

    Args:
        frames: the keyframes.
        scan: the new scan; its echoes count.
        pose: where it may have been taken, in the odometry's frame [m, m, rad].

    Returns:
        Residuals e of the ranges [m]; the derivative J of the virtual ranges by the
        pose, so that e ≈ J δ; and which are known: an echo whose ray meets a wall, and
        no veil before it.
    """

    def one(frame):
        outline, key = frame
        relative = geometry.between(key, pose)
        ranges, J = raycast_with_jacobian(
            outline, relative, scan.bearings, scan.range_max
        )
        c, s = jnp.cos(key[2]), jnp.sin(key[2])
        columns = c * J[:, 0] - s * J[:, 1], s * J[:, 0] + c * J[:, 1], J[:, 2]
        known = scan.echo & (ranges < scan.range_max)
        return scan.ranges - ranges, jnp.stack(columns, axis=-1), known

    # One after the other: rays of many worlds at once would leave the vector registers.
    return jax.lax.map(one, (frames.outlines, frames.poses))
