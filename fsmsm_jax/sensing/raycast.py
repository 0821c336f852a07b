"""Virtual scans: the ranges a lidar would read at a pose, with their exact derivative.

`raycast(world, pose, bearings)` is all that the rest of the house knows of a
world. On polygons each ray is intersected with every wall. On grids a ray walks
from cell to cell, exactly, but skips empty space: a cell whose nearest obstacle is
k cells away (chessboard distance) heads a free box of 2k − 1 cells, and the ray goes
straight to that box's exit. About five such hops finish a ray indoors.

A ray cast is differentiable however the hit was found. With the wall's normal n at
the hit, the ray's direction d, its derivative d′ by the heading and range r,

    dr = −(n·do + r n·d′ dφ) / (n·d)

(idea 2 of the design; A. Censi, ICRA 2007, uses it for the Fisher information). On
grids n is the slope of the blurred occupancy, so it is the wall a person sees and
not the face of a cell. Grazing rays divide by at least `_GRAZING`; rays that meet
nothing have derivative zero.
"""

import functools

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float

from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["raycast"]

_GRAZING = 0.1  # smallest |n·d|: rays within 6° of the wall have a capped derivative
_CHUNK = 1 << 18  # rays marched together: their state fits the last-level cache
_LEAF = 2048  # below this many rays compaction costs more than idle lanes
_WALLS = 4  # walls met between two looks at memory; more compile slower, not run faster
_HOPS = 10  # hops before the first compaction: nine rays of ten are done by then


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
        range_max: cap [m]; rays that meet nothing nearer read exactly this. A pose
            outside a grid sees nothing.

    Returns:
        One range [m] per bearing, in [0, range_max].

    Reference:
        scan_map, Algorithm XII of the thesis; derivative: Censi, ICRA 2007.
    """
    headings = pose[2] + bearings
    return _ranges(world, pose[:2], headings, jnp.asarray(range_max, headings.dtype))


@jax.custom_jvp
def _ranges(world, position, headings, range_max):
    ranges, _ = _first_hit(world, position, headings, range_max)
    return ranges


@_ranges.defjvp
def _ranges_jvp(primals, tangents):
    world, position, headings, range_max = primals
    _, d_position, d_headings, _ = tangents
    ranges, normal = _first_hit(world, position, headings, range_max)
    along = jnp.stack([jnp.cos(headings), jnp.sin(headings)], axis=-1)
    across = jnp.stack([-along[..., 1], along[..., 0]], axis=-1)
    facing = -jnp.sum(normal * along, axis=-1)
    # The normal faces the sensor, so facing ≥ 0; a blurred grid may say otherwise.
    slope = jnp.sum(normal * across, axis=-1) / jnp.maximum(facing, _GRAZING)
    pull = normal / jnp.maximum(facing, _GRAZING)[..., None]
    return ranges, pull @ d_position + ranges * slope * d_headings


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
    walls = jnp.stack([ax, ay, bx, by, (by - ay) * inverse, (ax - bx) * inverse])
    count = walls.shape[1]
    together = min(_WALLS, count)
    blocks = -(-count // together)
    walls = jnp.pad(walls, ((0, 0), (0, blocks * together - count)))

    def block(nearest, walls):
        # Unrolled, so that XLA keeps the rays in vector registers while walls pass.
        for ax, ay, bx, by, wx, wy in walls.T:
            closeness = dx * wx + dy * wy
            # The ray's line parts the wall's ends. Two walls that meet in a corner ask
            # this of the same corner by the same sum: no ray slips between them.
            parted = (ax * dy - ay * dx >= 0) != (bx * dy - by * dx >= 0)
            closer = parted & (closeness > nearest[0])
            nearest = tuple(
                jnp.where(closer, new, old)
                for new, old in zip((closeness, wx, wy), nearest, strict=True)
            )
        return nearest, None

    start = (jnp.zeros_like(dx),) * 3
    blocks = walls.reshape(6, blocks, together).transpose(1, 0, 2)
    (closeness, wx, wy), _ = jax.lax.scan(block, start, blocks)
    hit = closeness * range_max > 1
    ranges = jnp.where(hit, 1 / jnp.where(hit, closeness, 1.0), range_max)
    along = jnp.stack([dx, dy], axis=-1)
    return ranges, _towards_sensor(jnp.stack([wx, wy], axis=-1), along, hit)


def _hit_cells(world, position, headings, range_max):
    """Exact traversal in cell units, then the slope of the blurred occupancy."""
    o = jnp.broadcast_to(world.to_cells(position), (*headings.shape, 2))
    local = headings - world.origin[2]
    far = jnp.broadcast_to(range_max / world.resolution, headings.shape)
    t, column, row = _march(world.clearance, o[:, 0], o[:, 1], local, far)
    height, width = world.cells.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hit = inside & (t < far)
    ranges = jnp.where(hit, t * world.resolution, range_max)

    # Slope half a cell before the wall, where both faces of a thin wall do not cancel.
    d = jnp.stack([jnp.cos(local), jnp.sin(local)], axis=-1)
    x, y = (o + (t[:, None] - 0.5) * d).T - 0.5
    gradient = _bilinear_gradient(world.surface, x, y)
    c, s = jnp.cos(world.origin[2]), jnp.sin(world.origin[2])
    normal = -jnp.stack(
        [c * gradient[0] - s * gradient[1], s * gradient[0] + c * gradient[1]], axis=-1
    )
    along = jnp.stack([jnp.cos(headings), jnp.sin(headings)], axis=-1)
    return ranges, _towards_sensor(normal, along, hit)


def _towards_sensor(normal, along, hit: Bool[Array, "rays"]):
    length = jnp.linalg.norm(normal, axis=-1)
    usable = hit & (length > 1e-6)
    unit = normal / jnp.where(usable, length, 1.0)[:, None]
    flip = jnp.where(jnp.sum(unit * along, axis=-1) > 0, -1.0, 1.0)
    return jnp.where(usable[:, None], unit * flip[:, None], 0.0)


def _bilinear_gradient(field, x, y):
    """Central differences of a field over one cell, at (column, row) points."""
    height, width = field.shape

    def at(x, y):
        x, y = jnp.clip(x, 0, width - 1.001), jnp.clip(y, 0, height - 1.001)
        i, j = x.astype(int), y.astype(int)
        u, v = x - i, y - j
        lower = (1 - u) * field[j, i] + u * field[j, i + 1]
        upper = (1 - u) * field[j + 1, i] + u * field[j + 1, i + 1]
        return (1 - v) * lower + v * upper

    return at(x + 1, y) - at(x - 1, y), at(x, y + 1) - at(x, y - 1)


@custom_vmap
def _march(clearance, x, y, headings, far):
    """Walk flat batches of rays to the first cell that stops them.

    All in cell units, `headings` in the grid's frame. Returns the distance to the
    entry face of the last cell and that cell's column and row (outside the grid if
    the ray left it; distance ≥ far if the ray went too far).
    """
    rays = x.shape[0]
    chunk = min(_CHUNK, rays)
    chunks = -(-rays // chunk)
    padded = [jnp.pad(a, (0, chunks * chunk - rays)) for a in (x, y, headings, far)]

    def one(args):
        return _march_compacting(clearance, *_start(clearance, *args), _HOPS)

    if chunks == 1:
        return one(padded)
    walked = jax.lax.map(one, [a.reshape(chunks, chunk) for a in padded])
    return tuple(a.reshape(-1)[:rays] for a in walked)


@_march.def_vmap
def _march_flat(axis_size, in_batched, clearance, *rays):
    """Under `vmap`, more rays of the same kind: flatten, so that no lane idles."""
    spread = [
        a if b else jnp.broadcast_to(a, (axis_size, *a.shape))
        for a, b in zip(rays, in_batched[1:], strict=True)
    ]
    if in_batched[0]:  # many worlds: one after the other
        out = jax.lax.map(lambda args: _march(*args), (clearance, *spread))
    else:
        flat = _march(clearance, *(a.reshape(-1) for a in spread))
        out = tuple(a.reshape(axis_size, -1) for a in flat)
    return out, (True, True, True)


def _start(clearance, x, y, headings, far):
    """Per-ray constants (x, y, dx, dy, far) and state (t, column, row)."""
    dx, dy = jnp.cos(headings), jnp.sin(headings)
    tiny = jnp.finfo(dx.dtype).tiny ** 0.5  # so that no ray is parallel to an axis
    dx = jnp.where(jnp.abs(dx) < tiny, tiny, dx)
    dy = jnp.where(jnp.abs(dy) < tiny, tiny, dy)
    height, width = clearance.shape
    column = jnp.clip(jnp.floor(x), -1, width - 2).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), -1, height - 2).astype(jnp.int32)
    return (x, y, dx, dy, far), (jnp.zeros_like(x), column, row)


def _free_radius(clearance, column, row):
    """Clearance of the cell; the ring of padding shifts indices by one."""
    index = (row + 1) * clearance.shape[1] + column + 1
    return (
        clearance.reshape(-1).at[index].get(mode="promise_in_bounds").astype(jnp.int32)
    )


def _walking(clearance, ray, state):
    t, column, row = state
    return (_free_radius(clearance, column, row) > 0) & (t < ray[4])


def _hop(clearance, ray, state):
    """One jump to the exit of the free box around the current cell."""
    (x, y, dx, dy, far), (t, column, row) = ray, state
    k = _free_radius(clearance, column, row)
    right, up = dx > 0, dy > 0
    t_column = (jnp.where(right, column + k, column - k + 1) - x) / dx
    t_row = (jnp.where(up, row + k, row - k + 1) - y) / dy
    sideways = t_column < t_row
    t_exit = jnp.minimum(t_column, t_row)
    # The crossed index is set exactly; the other one may not leave the box by rounding.
    near_column = jnp.clip(
        jnp.floor(x + t_exit * dx).astype(jnp.int32), column - k + 1, column + k - 1
    )
    near_row = jnp.clip(
        jnp.floor(y + t_exit * dy).astype(jnp.int32), row - k + 1, row + k - 1
    )
    next_column = jnp.where(
        sideways, jnp.where(right, column + k, column - k), near_column
    )
    next_row = jnp.where(sideways, near_row, jnp.where(up, row + k, row - k))
    go = (k > 0) & (t < far)
    return (
        jnp.where(go, t_exit, t),
        jnp.where(go, next_column, column),
        jnp.where(go, next_row, row),
    )


def _march_compacting(clearance, ray, state, hops):
    """Hop a while, gather the unfinished rays into a short array, recurse on it.

    Long rays would otherwise hold up the whole batch. Gathers are cheap on every
    device and scatters are not, so results come back by a gather as well.
    """
    hop = functools.partial(_hop, clearance, ray)
    rays = ray[0].shape[0]
    if rays <= _LEAF:
        return jax.lax.while_loop(
            lambda state: jnp.any(_walking(clearance, ray, state)),
            lambda state: hop(hop(state)),
            state,
        )
    state = jax.lax.fori_loop(0, hops, lambda _, state: hop(state), state)
    walking = _walking(clearance, ray, state)
    place = jnp.cumsum(walking)
    short = -(-rays // 8)
    index = jnp.nonzero(walking, size=8 * short, fill_value=rays)[0]

    def block(b, walked):
        mine = jax.lax.dynamic_slice(index, (b * short,), (short,))
        *sub_ray, sub_far = (a.at[mine].get(mode="clip") for a in ray)
        sub_far = jnp.where(mine < rays, sub_far, -1.0)  # fillers stand still
        sub_state = tuple(a.at[mine].get(mode="clip") for a in state)
        done = _march_compacting(clearance, (*sub_ray, sub_far), sub_state, 2 * hops)
        return tuple(
            jax.lax.dynamic_update_slice(a, v, (b * short,))
            for a, v in zip(walked, done, strict=True)
        )

    walked = jax.lax.fori_loop(
        0,
        -(-place[-1] // short),
        block,
        tuple(jnp.zeros(8 * short, a.dtype) for a in state),
    )
    return tuple(
        jnp.where(walking, late.at[place - 1].get(mode="clip"), now)
        for late, now in zip(walked, state, strict=True)
    )
