r"""Worlds out of scans: how the thesis made its test environments.

A scan of half a circle shows half a room. The end points of its rays are that half's
outline; behind the sensor it is closed by an arc whose radius is the scan's smallest
range. The outline is then seen once more from where the sensor stood, in 360 rays
that start at −π: an ordered, closed, counter-clockwise polygon around the sensor, which
is *the* world of the experiment and, until noise is added, the robot's map of it.

From that one spot every wall is visible and the ray's range between two neighbours at
$r_0$ and $r_1$, Δ apart, has a closed form,

$$r(s) = \frac{r_0\, r_1 \sin Δ}{r_0 \sin s + r_1 \sin(Δ - s)}, \qquad 0 \le s \le Δ,$$

so that thousands of worlds take milliseconds, on the host and in float64. Readings
without echo (81.91 m) stay what they read, spikes in the outline, as in the thesis's
program (erratum E20). Who has no recordings takes `simulated_half_scans` of a floor
plan from `world.buildings`.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import OccupancyGrid

__all__ = ["Environments", "close_half_scans", "simulated_half_scans"]

_FREE = 0.3  # [m] from a simulated sensor to the nearest obstacle


class Environments(NamedTuple):
    """Closed worlds, each around the pose its scan was taken from."""

    outlines: Float[np.ndarray, "worlds vertices 2"]
    """Vertices in the map frame [m], counter-clockwise from behind the sensor."""
    poses: Float[np.ndarray, "worlds 3"]
    """Where the scans were taken [m, m, rad]: inside, and every wall in sight."""
    kept: Shaped[np.ndarray, "worlds"]
    """Which of the scans these are, ascending."""
    dropped: int
    """How many scans made no world: a range was not finite, or not positive."""


def close_half_scans(
    ranges: Shaped[np.ndarray, "scans rays"] | Float[Array, "scans rays"],
    poses: Shaped[np.ndarray, "scans 3"] | Float[Array, "scans 3"] | None = None,
    vertices: int = 360,
) -> Environments:
    """Closed worlds from scans that cover half a circle.

    An odd number of rays (181, 361) spans −90°..+90° with both ends, an even one (180,
    360) lacks the last, as in the CARMEN logs that the thesis uses. The outline is the
    scan, filled up behind to a full circle by its smallest range.

    Args:
        ranges: half-plane scans [m], ray 0 at −90°. A scan with a range that is not
            finite or not positive cannot be closed and is dropped; readings of no echo
            are ranges like any other.
        poses: where they were taken [m, m, rad]; at the origin if left out.
        vertices: of each world, one every 2π/vertices, the first straight behind.

    Raises:
        ValueError: fewer than 3 rays or vertices.

    Example:
        >>> worlds = close_half_scans(np.array([[2.0, 3.0, 4.0, 3.0, 2.5]]), vertices=8)
        >>> worlds.outlines[0].round(3).tolist()[2:5]  # at −90°, −45°, 0°
        [[0.0, -2.0], [2.121, -2.121], [4.0, 0.0]]

    Reference:
        Thesis §6.5; steps 1 and 2 of the protocol of its program (closing "method 4").
    """
    ranges = np.asarray(ranges, float)
    scans, rays = ranges.shape
    if rays < 3 or vertices < 3:
        raise ValueError(
            f"expected scans of at least 3 rays and worlds of at least 3 vertices, "
            f"got {rays} and {vertices}"
        )
    poses = np.zeros((scans, 3)) if poses is None else np.asarray(poses, float)
    kept = np.flatnonzero(np.all(np.isfinite(ranges) & (ranges > 0), axis=1))
    ranges, poses = ranges[kept], poses[kept]

    around = 2 * (rays - rays % 2)  # rays in a full circle
    smallest = ranges.min(axis=1, keepdims=True, initial=np.inf)
    behind = np.broadcast_to(smallest, (len(kept), around - rays))
    circle = np.roll(np.concatenate([ranges, behind], axis=1), around // 4, axis=1)

    spacing = 2 * math.pi / around
    place = np.arange(vertices) * around / vertices
    first = np.floor(place).astype(int)
    s = (place - first) * spacing
    r0, r1 = circle[:, first], circle[:, (first + 1) % around]
    seen = r0 * r1 * np.sin(spacing) / (r0 * np.sin(s) + r1 * np.sin(spacing - s))

    headings = poses[:, 2:] - math.pi + 2 * math.pi * np.arange(vertices) / vertices
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    return Environments(
        outlines=poses[:, None, :2] + seen[..., None] * directions,
        poses=poses,
        kept=kept,
        dropped=scans - len(kept),
    )


def simulated_half_scans(
    key: PRNGKeyArray,
    world: OccupancyGrid,
    scans: int,
    rays: int = 361,
    range_max: float = 30.0,
    noise: float = 0.01,
) -> tuple[Float[Array, "scans rays"], Float[Array, "scans 3"]]:
    """Scans of half a circle from random free places: recordings for who has none.

    Args:
        key: of the places and the noise.
        world: what to scan, such as `buildings.office()`.
        scans: how many.
        rays: of each, over −90°..+90°; odd, so that both ends are in.
        range_max: what a ray without echo reads [m].
        noise: standard deviation of an echo [m].

    Returns:
        Ranges [m] and the poses they were taken from [m, m, rad]: what
        `close_half_scans` wants.

    Raises:
        ValueError: an even number of rays, or no free cell 0.3 m from all obstacles.
    """
    if rays % 2 == 0:
        raise ValueError(f"half a circle with both its ends has odd rays, got {rays}")
    rows, columns = np.nonzero(np.asarray(world.free & (world.distance >= _FREE)))
    if rows.size == 0:
        raise ValueError(f"no free cell is {_FREE} m from all obstacles")
    key_cell, key_within, key_yaw, key_noise = jax.random.split(key, 4)
    pick = jax.random.randint(key_cell, (scans,), 0, rows.size)
    cells = jnp.stack([jnp.asarray(columns)[pick], jnp.asarray(rows)[pick]], axis=-1)
    xy = world.to_map(cells + jax.random.uniform(key_within, (scans, 2)))
    yaw = jax.random.uniform(key_yaw, (scans, 1), minval=-jnp.pi, maxval=jnp.pi)
    poses = jnp.concatenate([xy, yaw], axis=1)

    lidar = Lidar.create(rays, math.pi, range_max, noise)
    return _scan(jax.random.split(key_noise, scans), world, poses, lidar), poses


@jax.jit
def _scan(keys, world, poses, lidar):
    cast = jax.vmap(raycast, (None, 0, None, None))
    exact = cast(world, poses, lidar.bearings, lidar.range_max)
    return jax.vmap(lidar.measure)(keys, exact).ranges
