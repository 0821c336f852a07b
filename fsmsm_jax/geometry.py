"""Planar poses: the one piece of geometry everything else stands on.

A pose is a plain array `[x, y, θ]`, metres and radians, θ wrapped to [−π, π).
There is no pose class: SE(2) needs three functions, and plain arrays go through
`vmap`, `grad` and `lax.scan` untouched. Names carry the frames: `pose_map_lidar`
is the pose of the lidar in the map, and chains read from left to right,
`compose(pose_map_base, pose_base_lidar)`. Axes follow ROS REP 103: x forward,
y to the left, θ counter-clockwise.

The end points of a scan, joined, are a polygon; its area and centroid come from
Green's theorem, as sums over the outline.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = [
    "between",
    "compose",
    "inverse",
    "polygon_area",
    "polygon_centroid",
    "transform_points",
    "wrap",
]

_ROUNDING = 16  # ulps that an area may have of its terms' size and still be none


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


def polygon_area(vertices: Float[Array, "vertices 2"]) -> Float[Array, ""]:
    r"""Signed area [m²] of a closed polygon, positive if it runs counter-clockwise.

    $A = \frac12 \sum_k (x_k y_{k+1} - x_{k+1} y_k)$, counted from the mean of the
    vertices, so that float32 keeps its digits wherever the polygon lies.

    Args:
        vertices: in order [m]; the last is joined to the first, do not repeat it.

    Example:
        >>> float(polygon_area(jnp.array([[5.0, 1.0], [7.0, 1.0], [7.0, 4.0]])))
        3.0

    Reference:
        Thesis draft, eq. 1.12 (Green's theorem).

    Note:
        Where the outline crosses itself, parts count by how often it winds around
        them. Differentiable.
    """
    local = vertices - vertices.mean(axis=0)[None]
    return _triangles(local)[1].sum() / 2


def polygon_centroid(vertices: Float[Array, "vertices 2"]) -> Float[Array, "2"]:
    r"""Centre of mass [m] of the inside of a closed polygon.

    $\frac1{6A} \sum_k (p_k + p_{k+1})(x_k y_{k+1} - x_{k+1} y_k)$, whichever way round
    it runs.

    Args:
        vertices: in order [m]; the last is joined to the first, do not repeat it.

    Returns:
        The centroid; the mean of the vertices of a polygon without area (a point, a
        line there and back), as far as the precision of its numbers can tell.

    Example:
        >>> polygon_centroid(jnp.array([[5.0, 1.0], [8.0, 1.0], [8.0, 4.0]])).tolist()
        [7.0, 2.0]

    Reference:
        Thesis draft, eq. 1.15 and 1.16.

    Note:
        Differentiable.
    """
    middle = vertices.mean(axis=0)
    local = vertices - middle[None]
    pair, cross, size = _triangles(local)
    area = cross.sum()
    flat = jnp.abs(area) <= _ROUNDING * jnp.finfo(area.dtype).eps * size.sum()
    moment = jnp.sum(pair * cross[:, None], axis=0)
    return middle + jnp.where(flat, 0.0, moment / jnp.where(flat, 1.0, 3 * area))


def _triangles(local):
    """Of each edge and the origin: p_k + p_{k+1}, twice the area, its terms' size."""
    following = jnp.roll(local, -1, axis=0)
    (x0, y0), (x1, y1) = local.T, following.T
    one, two = x0 * y1, x1 * y0
    return local + following, one - two, jnp.abs(one) + jnp.abs(two)
