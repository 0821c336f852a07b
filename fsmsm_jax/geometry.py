"""Planar poses: the one piece of geometry everything else stands on.

A pose is a plain array `[x, y, θ]`, metres and radians, θ wrapped to [−π, π).
There is no pose class: SE(2) needs three functions, and plain arrays go through
`vmap`, `grad` and `lax.scan` untouched. Names carry the frames: `pose_map_lidar`
is the pose of the lidar in the map, and chains read from left to right,
`compose(pose_map_base, pose_base_lidar)`. Axes follow ROS REP 103: x forward,
y to the left, θ counter-clockwise.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["between", "compose", "inverse", "transform_points", "wrap"]


def wrap(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """The same angle [rad] in [−π, π).

    Example:
        >>> round(float(wrap(jnp.asarray(3.5 * jnp.pi))), 3)
        -1.571
    """
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def compose(
    pose_a_b: Float[Array, "3"], pose_b_c: Float[Array, "3"]
) -> Float[Array, "3"]:
    """The pose of c in a, from the pose of b in a and of c in b.

    Example:
        >>> turned = jnp.array([1.0, 2.0, jnp.pi / 2])
        >>> [round(v, 3) for v in compose(turned, jnp.array([1.0, 0.0, 0.0])).tolist()]
        [1.0, 3.0, 1.571]
    """
    xy = transform_points(pose_a_b, pose_b_c[:2])
    return jnp.concatenate([xy, wrap(pose_a_b[2:] + pose_b_c[2:])])


def inverse(pose_a_b: Float[Array, "3"]) -> Float[Array, "3"]:
    """The pose of a in b; composed with the pose of b in a it is the identity."""
    x, y, theta = pose_a_b
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.stack([-(c * x + s * y), s * x - c * y, wrap(-theta)])


def between(
    pose_a_b: Float[Array, "3"], pose_a_c: Float[Array, "3"]
) -> Float[Array, "3"]:
    """The pose of c in b, from two poses in the same frame a."""
    return compose(inverse(pose_a_b), pose_a_c)


def transform_points(
    pose_a_b: Float[Array, "3"], points_b: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 2"]:
    """Points [m] given in frame b, expressed in frame a."""
    x, y, theta = pose_a_b
    c, s = jnp.cos(theta), jnp.sin(theta)
    px, py = points_b[..., 0], points_b[..., 1]
    return jnp.stack([x + c * px - s * py, y + s * px + c * py], axis=-1)
