"""Virtual scans: the ranges a lidar would read at a pose, with their exact derivative.

`raycast(world, pose, bearings)` is all that the rest of the house knows of a
world. On polygons each ray is intersected with every wall; on grids it walks from cell
to cell, in hops over empty space (`march.py`). Both are exact.

A ray cast is differentiable however the hit was found. With the wall's normal n at
the hit, the ray's direction d, its derivative d′ by the heading and range r,

    dr = −(n·do + r n·d′ dφ) / (n·d)

(idea 2 of the design; A. Censi, ICRA 2007, uses it for the Fisher information). On
grids n is the slope of the blurred occupancy, so it is the wall a person sees and
not the face of a cell. Grazing rays divide by at least `_GRAZING`; rays that meet
nothing have derivative zero.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax.sensing.march import march
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["raycast", "raycast_with_jacobian"]

_GRAZING = 0.1  # smallest |n·d|: rays within 6° of the wall have a capped derivative
_WALLS = 4  # walls met between two looks at memory; more compile slower, not run faster


def raycast(
    world: OccupancyGrid | PolygonMap,
    pose: Float[Array, "3"],
    bearings: Float[Array, "rays"],
    range_max: float | Float[Array, ""] = 30.0,
) -> Float[Array, "rays"]:
    """Ranges [m] to the first obstacle along each bearing, seen from a pose.

    Differentiable in `pose` and `bearings`; `vmap` over poses, bearings or worlds
    casts all rays as one flat batch.

    Args:
        world: an `OccupancyGrid` or a `PolygonMap`.
        pose: [x, y, θ] of the sensor in the map frame [m, m, rad].
        bearings: directions of the rays in the sensor frame [rad].
        range_max: cap [m]; rays that meet nothing nearer, or first the front of a
            polygon's veil, read exactly this. A pose outside a grid sees nothing.

    Returns:
        One range [m] per bearing, in [0, range_max].

    Reference:
        scan_map, Algorithm XII of the thesis; derivative: Censi, ICRA 2007.
    """
    headings = pose[2] + bearings
    return _ranges(world, pose[:2], headings, jnp.asarray(range_max, headings.dtype))


@jax.custom_jvp
def _ranges(world, position, headings, range_max):
    return _first_hit(world, position, headings, range_max)[0]


@_ranges.defjvp
def _ranges_jvp(primals, tangents):
    _, d_position, d_headings, _ = tangents
    ranges, pull, turn = _slopes(*primals)
    return ranges, pull @ d_position + turn * d_headings


def raycast_with_jacobian(
    world: OccupancyGrid | PolygonMap,
    pose: Float[Array, "3"],
    bearings: Float[Array, "rays"],
    range_max: float | Float[Array, ""] = 30.0,
) -> tuple[Float[Array, "rays"], Float[Array, "rays 3"]]:
    """`raycast` and its derivative by the pose, for little more than the cast.

    What `jax.linearize` or `jax.jacfwd` of `raycast` would give, without their passes
    over the rays: fits do nothing else all day.

    Returns:
        One range [m] per bearing, and ∂range / ∂(x, y, θ) [1, 1, m/rad].
    """
    headings = pose[2] + bearings
    limit = jnp.asarray(range_max, headings.dtype)
    ranges, pull, turn = _slopes(world, pose[:2], headings, limit)
    return ranges, jnp.concatenate([pull, turn[:, None]], axis=1)


def _slopes(world, position, headings, range_max):
    """Ranges, and their derivatives by the position (rays, 2) and by the heading."""
    # Components stay apart: arrays with a last axis of 2 would leave most lanes idle.
    ranges, nx, ny = _first_hit(world, position, headings, range_max)
    dx, dy = jnp.cos(headings), jnp.sin(headings)
    # The normal faces the sensor, so facing ≥ 0; a blurred grid may say otherwise.
    facing = jnp.maximum(-(nx * dx + ny * dy), _GRAZING)
    pull = nx / facing, ny / facing
    return ranges, jnp.stack(pull, axis=-1), ranges * (pull[1] * dx - pull[0] * dy)


def _first_hit(world, position, headings, range_max):
    """Ranges and the unit normals that face the sensor (zero where nothing is hit)."""
    if isinstance(world, PolygonMap):
        return _hit_segments(world, position, headings, range_max)
    return _hit_cells(world, position, headings, range_max)


def _hit_segments(world, position, headings, range_max):
    """Nearest intersection with any wall, by the walls' polar duals.

    Seen from the sensor, a wall from a to b lies on the line w · z = 1 with
    w = (b_y − a_y, a_x − b_x) / (a × b), so along direction d it is met at
    1 / r = w · d: no division a pair of ray and wall, and w is the normal as well.
    """
    dx, dy = jnp.cos(headings), jnp.sin(headings)
    (ax, ay), (bx, by) = (
        (world.start - position[None]).T,
        (world.end - position[None]).T,
    )
    area = ax * by - ay * bx
    inverse = jnp.where(area == 0, 0.0, 1 / jnp.where(area == 0, 1.0, area))
    if world.solid is not None:  # from behind, a veil hides nothing
        inverse = jnp.where(world.solid | (area > 0), inverse, 0.0)
    w = jnp.stack([by - ay, ax - bx]) * inverse[None]
    count = w.shape[1]
    walls = jnp.stack([ax, ay, bx, by, *w, jnp.arange(count, dtype=w.dtype)])
    together = min(_WALLS, count)
    blocks = -(-count // together)
    walls = jnp.pad(walls, ((0, 0), (0, blocks * together - count)))

    def block(nearest, walls):
        # Unrolled, so that XLA keeps the rays in vector registers while walls pass.
        for ax, ay, bx, by, wx, wy, index in walls.T:
            closeness = dx * wx + dy * wy
            # The ray's line parts the wall's ends. Two walls that meet in a corner ask
            # this of the same corner by the same sum: no ray slips between them.
            parted = (ax * dy - ay * dx >= 0) != (bx * dy - by * dx >= 0)
            closer = parted & (closeness > nearest[0])
            nearest = tuple(
                jnp.where(closer, new, old)
                for new, old in zip((closeness, index), nearest, strict=True)
            )
        return nearest, None

    start = (jnp.zeros_like(dx),) * 2
    blocks = walls.reshape(7, blocks, together).transpose(1, 0, 2)
    (closeness, index), _ = jax.lax.scan(block, start, blocks)
    hit = closeness * range_max > 1
    wall = index.astype(int)
    if world.solid is not None:
        hit &= world.solid[wall]
    ranges = jnp.where(hit, 1 / jnp.where(hit, closeness, 1.0), range_max)
    return ranges, *_towards_sensor(w[0, wall], w[1, wall], dx, dy, hit)


def _hit_cells(world, position, headings, range_max):
    """Exact traversal in cell units, then the slope of the blurred occupancy."""
    o = jnp.broadcast_to(world.to_cells(position), (*headings.shape, 2))
    local = headings - world.origin[2]
    far = jnp.broadcast_to(range_max / world.resolution, headings.shape)
    t, column, row = march(world.clearance, o[:, 0], o[:, 1], local, far)
    height, width = world.extent
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hit = inside & (t < far)
    ranges = jnp.where(hit, t * world.resolution, range_max)

    # Slope half a cell before the wall, where both faces of a thin wall do not cancel.
    x = o[:, 0] + (t - 0.5) * jnp.cos(local) - 0.5
    y = o[:, 1] + (t - 0.5) * jnp.sin(local) - 0.5
    gx, gy = _interpolated(world.slope, x, y, world.extent)
    c, s = jnp.cos(world.origin[2]), jnp.sin(world.origin[2])
    normal = s * gy - c * gx, -s * gx - c * gy
    return ranges, *_towards_sensor(*normal, jnp.cos(headings), jnp.sin(headings), hit)


def _towards_sensor(nx, ny, dx, dy, hit: Bool[Array, "rays"]):
    """The unit normal on the sensor's side, nought where nothing is hit."""
    length = jnp.sqrt(nx * nx + ny * ny)
    usable = hit & (length > 1e-6)
    sign = jnp.where(nx * dx + ny * dy > 0, -1.0, 1.0)
    scale = jnp.where(usable, sign / jnp.where(usable, length, 1.0), 0.0)
    return nx * scale, ny * scale


def _interpolated(field, x, y, extent):
    """The two components of a field, bilinear, at (column, row) points."""
    height, width = extent
    x, y = jnp.clip(x, 0, width - 1.001), jnp.clip(y, 0, height - 1.001)
    i, j = x.astype(int), y.astype(int)
    u, v = x - i, y - j
    corners = [
        ((1 - u) * (1 - v), field[j, i]),
        (u * (1 - v), field[j, i + 1]),
        ((1 - u) * v, field[j + 1, i]),
        (u * v, field[j + 1, i + 1]),
    ]
    return tuple(sum(share * f[:, axis] for share, f in corners) for axis in (0, 1))
