r"""Cases: what a matcher is asked, with the noise still in the drawer.

A case is a world, the pose a robot truly has in it, the pose it believes it has, and
what its lidar would read without noise. The noise is kept beside it as unit normal
draws, so that one set of cases serves every σ: results for two noise levels, or of two
methods, then differ by what was asked and not by luck, and may be compared case by
case.

`noisy` mixes them in: the real scan gets $σ_R z$ on its ranges and the map $σ_M z$ on
its vertices, in x and in y; the world itself stays as it is. `draw_cases` samples as
the thesis's program does: true poses anywhere in the world but near a wall, beliefs up
to 0.2 m (in x, in y) and 45° away. `scan_to_scan` turns scan-to-map cases into the
scan-to-scan ones of the thesis's chapter 7.

All is computed in the precision JAX is in. Float32 keeps ranges to a few µm, a thousand
times finer than the finest noise asked about.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from fsmsm_jax import geometry
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import PolygonMap

__all__ = [
    "DISPLACEMENTS",
    "FARTHEST",
    "Cases",
    "as_worlds",
    "bearings",
    "draw_cases",
    "noisy",
    "noisy_ranges",
    "published_cases",
    "scan_to_scan",
]

FARTHEST = 1000.0
"""What a ray that leaves the world reads [m]. Worlds reach to 81.91 m from the sensor;
give a matcher this `range_max` too, or it sees an end of the world at its default."""

DISPLACEMENTS = (
    (0.05, 0.035),
    (0.10, 0.070),
    (0.15, 0.150),
    (0.20, 0.300),
    (0.20, 0.560),
    (0.20, math.pi / 4),
)
"""Δ0 to Δ5 of the thesis's chapter 7, (δ_xy [m], δ_θ [rad]); Δ5 is chapter 6's."""

_CLEARANCE = 0.5  # [m] from a true pose to the walls
_START_CLEARANCE = 0.25  # [m] from an initial pose to the vertices
_RELAXED_BY = 0.01  # [m] less of it after each round without success
_ROUND, _TRIES = 50, 1000  # at once; before the pose of the recording is taken
_TOGETHER = 64  # scans cast at once


class Cases(NamedTuple):
    """Questions to a matcher, all arrays along the same first axis."""

    outlines: Float[Array, "cases walls 2"]
    """Vertices of the closed, noise-free worlds, map frame [m]."""
    true: Float[Array, "cases 3"]
    """Where the scans are taken [m, m, rad]."""
    initial: Float[Array, "cases 3"]
    """Where the robot believes to be [m, m, rad]."""
    ranges: Float[Array, "cases rays"]
    """Noise-free real scans [m], ray n at bearing −π + 2πn/N, at most `FARTHEST`."""
    z_range: Float[Array, "cases rays"]
    """Unit normal draws for the ranges."""
    z_map: Float[Array, "cases walls 2"]
    """Unit normal draws for the vertices."""


def draw_cases(
    key: PRNGKeyArray,
    outlines: Shaped[np.ndarray, "cases walls 2"] | Float[Array, "cases walls 2"],
    poses: Shaped[np.ndarray, "cases 3"] | Float[Array, "cases 3"],
    offset: float = 0.2,
    turn: float = math.pi / 4,
    rays: int = 360,
) -> Cases:
    """One case in each world, sampled as in the published evaluation.

    The true position is uniform in the world, at least 0.5 m from its walls; after
    1000 tries in the world's bounding box without success the recording's pose is
    taken. The initial pose is uniform around it, inside the world and at least 0.25 m
    from every vertex, 0.01 m less after each 50 tries.

    Args:
        key: of everything drawn; for E repeats, E keys.
        outlines: the worlds, ordered vertices in the map frame [m].
        poses: where they were recorded [m, m, rad].
        offset: largest displacement δ_xy along x and along y [m].
        turn: largest displacement δ_θ in heading [rad].
        rays: N_s of the real scan.

    Reference:
        Thesis §6.5 and steps 3 to 5 of its program. That asks for 0.5 m to vertices
        and along 360 rays, which is 0.5 m to the walls up to 0.02 mm.
    """
    outlines, poses = jnp.asarray(outlines, float), jnp.asarray(poses, float)
    return _draw_cases(key, outlines, poses, offset, turn, rays)


@jax.jit(static_argnames="rays")
def _draw_cases(key, outlines, poses, offset, turn, rays):
    key_true, key_initial, key_range, key_map = jax.random.split(key, 4)
    count = len(outlines)
    # One case after the other: most need one round of tries, some all of them.
    true = jax.lax.map(
        lambda args: _true_pose(*args),
        (jax.random.split(key_true, count), outlines, poses),
    )
    displacement = jnp.stack([offset, offset, turn]).astype(true.dtype)
    initial = jax.lax.map(
        lambda args: _initial_pose(displacement, *args),
        (jax.random.split(key_initial, count), outlines, true),
    )
    dtype = outlines.dtype
    return Cases(
        outlines=outlines,
        true=true,
        initial=initial,
        ranges=_cast(as_worlds(outlines), true, rays),
        z_range=jax.random.normal(key_range, (count, rays), dtype),
        z_map=jax.random.normal(key_map, outlines.shape, dtype),
    )


def _true_pose(key, outline, fallback):
    """Uniform in the bounding box until a try is inside and clear of the walls."""
    world = as_worlds(outline)
    low, high = outline.min(axis=0), outline.max(axis=0)

    def attempt(state):
        key, tried, _, _ = state
        key, now = jax.random.split(key)
        xy = jax.random.uniform(now, (_ROUND, 2), low.dtype, low, high)
        good = world.contains(xy) & (world.distance_at(xy) >= _CLEARANCE)
        return key, tried + _ROUND, xy[jnp.argmax(good)], good.any()

    key, key_yaw = jax.random.split(key)
    _, _, xy, found = jax.lax.while_loop(
        lambda state: ~state[3] & (state[1] < _TRIES),
        attempt,
        (key, 0, fallback[:2], jnp.asarray(False)),
    )
    yaw = jax.random.uniform(key_yaw, (1,), low.dtype, -jnp.pi, jnp.pi)
    return jnp.where(found, jnp.concatenate([xy, yaw]), fallback)


def _initial_pose(displacement, key, outline, true):
    """Uniform around the true pose until a try is inside and clear of the vertices."""
    world = as_worlds(outline)

    def attempt(state):
        key, clearance, _, _ = state
        key, now = jax.random.split(key)
        shape = (_ROUND, 3)
        away = displacement[None] * jax.random.uniform(
            now, shape, true.dtype, -1.0, 1.0
        )
        xy = true[None, :2] + away[:, :2]
        to_vertex = jnp.linalg.norm(xy[:, None] - outline[None], axis=-1).min(axis=1)
        good = world.contains(xy) & (to_vertex >= clearance)
        return key, clearance - _RELAXED_BY, away[jnp.argmax(good)], good.any()

    _, _, away, found = jax.lax.while_loop(
        lambda state: ~state[3] & (state[1] > -_START_CLEARANCE),
        attempt,
        (key, jnp.asarray(_START_CLEARANCE), jnp.zeros(3), jnp.asarray(False)),
    )
    initial = true + jnp.where(found, away, 0.0)
    return initial.at[2].set(geometry.wrap(initial[2]))


def published_cases(
    arrays: Mapping[str, np.ndarray], exact_ranges: bool = False
) -> Cases:
    """The same record from arrays that somebody else's program left.

    Args:
        arrays: `map_x`, `map_y` (cases, walls) [m]; `true_pose`, `initial_pose`
            (cases, 3) [m, m, rad]; `real_scan` (cases, rays) [m]; the unit draws
            `z_range`, `z_map_x`, `z_map_y`.
        exact_ranges: take the draws `z_map_x_when_sigmaR0`, `z_map_y_when_sigmaR0`
            that the program makes when it has drawn none for the ranges (σ_R = 0).
    """
    when = "_when_sigmaR0" if exact_ranges else ""
    xy = lambda x, y: jnp.asarray(np.stack([arrays[x], arrays[y]], axis=-1), float)
    return Cases(
        outlines=xy("map_x", "map_y"),
        true=jnp.asarray(arrays["true_pose"], float),
        initial=jnp.asarray(arrays["initial_pose"], float),
        ranges=jnp.asarray(arrays["real_scan"], float),
        z_range=jnp.asarray(arrays["z_range"], float),
        z_map=xy(f"z_map_x{when}", f"z_map_y{when}"),
    )


@jax.jit
def noisy(
    cases: Cases,
    sigma_R: float | Float[Array, ""] = 0.0,
    sigma_M: float | Float[Array, ""] = 0.0,
) -> tuple[PolygonMap, Float[Array, "cases rays"]]:
    """What the matcher is given: the maps (batched) and the real scans [m].

    Args:
        cases: with their draws.
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of each coordinate of the map's vertices [m].
    """
    return (
        as_worlds(cases.outlines + sigma_M * cases.z_map),
        noisy_ranges(cases.ranges, cases.z_range, sigma_R),
    )


def noisy_ranges(
    ranges: Float[Array, "*batch rays"],
    z: Float[Array, "*batch rays"],
    sigma: float | Float[Array, ""],
) -> Float[Array, "*batch rays"]:
    r"""Ranges [m] plus σz, drawn again where that is negative.

    Given that $z < -a$ with $a = r / σ$, the share $u = Φ(z) / Φ(-a)$ is uniform on
    (0, 1), as fresh as any other number; $Φ^{-1}(Φ(-a) + u (1 - Φ(-a)))$ is therefore
    the draw that a loop would end with, and `z` is all the randomness it takes.
    """
    noisy = ranges + sigma * z
    refused = noisy < 0
    a = ranges / jnp.where(refused, sigma, 1.0)
    below = jnp.where(refused, ndtr(-a), 0.5)
    share = jnp.where(refused, ndtr(z) / below, 0.5).clip(0, 1 - 1e-6)
    again = jnp.maximum(ndtri(below + share * (1 - below)), -a)
    return jnp.where(refused, ranges + sigma * again, noisy)


@jax.jit
def scan_to_scan(cases: Cases, sigma_R: float | Float[Array, ""] = 0.0) -> Cases:
    """The cases of chapter 7: the map is a scan taken at the initial pose.

    That scan is as noisy as the real one; joined up, its end points are the map, in
    its own frame. So the initial pose is zero, and the truth is where the real scan
    was taken as seen from there. The noise of the map is now in the map: go on with
    `noisy(cases, sigma_R, 0)`.

    Args:
        cases: scan-to-map cases; their x-draws for the map become the scan's.
        sigma_R: standard deviation of the ranges of that scan [m].

    Reference:
        FSM, Algorithm XXIV of the thesis; step 7 of its program.
    """
    rays = cases.outlines.shape[1]
    exact = _cast(as_worlds(cases.outlines), cases.initial, rays)
    ranges = noisy_ranges(exact, cases.z_map[..., 0], sigma_R)
    a = bearings(rays, ranges.dtype)
    directions = jnp.stack([jnp.cos(a), jnp.sin(a)], axis=-1)
    return cases._replace(
        outlines=ranges[..., None] * directions[None],
        true=jax.vmap(geometry.between)(cases.initial, cases.true),
        initial=jnp.zeros_like(cases.initial),
    )


def as_worlds(outlines: Float[Array, "*batch walls 2"]) -> PolygonMap:
    """Maps whose walls join the vertices [m] in order, the last to the first.

    The fields keep the leading axes of the outlines, for `vmap`.
    """
    build = lambda outline: PolygonMap(outline, jnp.roll(outline, -1, axis=0))
    for _ in outlines.shape[:-2]:
        build = jax.vmap(build)
    return build(outlines)


def bearings(rays: int, dtype) -> Float[Array, "rays"]:
    """Directions −π + 2πn/rays of a panoramic scan in its own frame [rad]."""
    return jnp.asarray(np.linspace(-np.pi, np.pi, rays, endpoint=False), dtype)


def _cast(worlds, poses, rays):
    """Noise-free panoramic scans [m], each in its own world."""
    a = bearings(rays, poses.dtype)
    cast = lambda args: raycast(args[0], args[1], a, FARTHEST)
    return jax.lax.map(cast, (worlds, poses), batch_size=min(_TOGETHER, len(poses)))
