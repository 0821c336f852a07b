"""End points against the whole map: all positions and headings, by the DFT.

A pose is good when the scan's end points fall on walls. With L the map's likelihood
field and p_i the end points turned by a heading, the score of every position x,

    S(x) = Σ_i w_i L(x + p_i),

is one cross-correlation: the product of the map's spectrum with the conjugate
spectrum of the image that the end points make. So a tile of the map costs one FFT a
heading, whatever the number of positions, and loses nothing to a brute-force search
on the same lattice. Points *inside* the rays enter with negative weight: space the
sensor looked through should not lie on a wall.

(E. Olson, "Real-time correlative scan matching", ICRA 2009, does the sums; the DFT
does them all at once.)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas
from fsmsm_jax.localisation.lattice import Lattice
from fsmsm_jax.localisation.shells import places_left, scan_shells
from fsmsm_jax.localisation.tiles import Tiles
from fsmsm_jax.sensing.lidar import Scan

__all__ = [
    "Ranking",
    "all_headings",
    "best_of_all",
    "rank_poses",
    "rank_tiles",
    "scan_spectra",
    "tiles_left",
]

_THROUGH = (0.3, 0.55, 0.8)  # where along a ray its free space is probed
_THROUGH_WEIGHT = 0.5  # of all probes of a ray, against its end point's 1
_CLEAR_OF_WALL = 0.75  # [m] probes nearer to the end point would blur into its wall
_SECTOR = 2  # neighbouring headings of which only the better is kept
_TICKS = 1 << 20  # in which scores are told: float32 holds them exactly
_NOWHERE = -2.0  # score of a node where none may stand
_LEAST = -1.5  # others' at least: few echoes and long ways sum up to less


class Ranking(NamedTuple):
    """Lattice poses, best first."""

    poses: Float[Array, "count 3"]
    """Of the lidar in the map [m, m, rad]."""
    score: Float[Array, "count"]
    """At most 1; −2 where there were no more poses."""


def rank_poses(atlas: ScanAtlas, scan: Scan, headings: int, count: int) -> Ranking:
    """The best lattice poses for a scan, apart from each other, best first.

    Args:
        atlas: the map's atlas.
        scan: the real scan; echoes within the atlas's reach vote.
        headings: how many headings to try, an even number (static).
        count: how many poses to return at most (static). Of two neighbouring headings
            at one node only the better is listed.
    """
    tiles, config = atlas.tiles, atlas.config
    left = tiles_left(tiles, config, scan)
    spectra = scan_spectra(config, tiles.side, scan, all_headings(headings))
    listed = rank_tiles(tiles.spectra, left, spectra, count)
    return best_of_all(listed, tiles, atlas.lattice, headings, count)


def tiles_left(
    tiles: Tiles, config: AtlasConfig, scan: Scan
) -> Bool[Array, "tiles core core"]:
    """Nodes that the scan may come from, by their shells."""
    seen = scan_shells(scan, config.rays, config.reach)
    return tiles.allowed & places_left(seen, tiles.shells)


def rank_tiles(
    tiles: Complex[Array, "tiles side half_side"],
    left: Bool[Array, "tiles core core"],
    scan: Complex[Array, "headings side half_side"],
    count: int,
) -> tuple[Float[Array, "tiles few"], Int[Array, "tiles few"]]:
    """Each tile's best: score and heading in one number, and where that is.

    Args:
        tiles: spectra of the likelihood field.
        left: nodes that are not ruled out; a tile without any is skipped.
        scan: conjugate spectra of the scan's images.
        count: how many to list, at most.
    """
    headings, side, _ = scan.shape
    core = left.shape[-1]
    rim = (side - core) // 2
    few = min(count, headings // _SECTOR * core**2)

    def correlate(spectrum, left):
        score = jnp.fft.irfft2(scan * spectrum[None], s=(side, side))
        score = score[:, rim : rim + core, rim : rim + core]
        score = jnp.where(left[None], jnp.maximum(score, _LEAST), _NOWHERE)
        pairs = score.reshape(-1, _SECTOR, core, core)
        # One whole number holds score and heading, for XLA's argmax is slow on the CPU;
        # a float, for its top_k sorts everything if it is given integers.
        which = jnp.arange(_SECTOR, dtype=score.dtype)[None, :, None, None]
        pairs = jnp.round(pairs * _TICKS) * _SECTOR + which
        return tuple(jax.lax.top_k(pairs.max(axis=1).reshape(-1), few))

    def skip(spectrum, left):
        nothing = jnp.full(few, _NOWHERE * _TICKS * _SECTOR, scan.real.dtype)
        return nothing, jnp.zeros(few, jnp.int32)

    one = lambda tile: jax.lax.cond(jnp.any(tile[1]), correlate, skip, *tile)
    return jax.lax.map(one, (tiles, left))


def best_of_all(
    listed: tuple[Array, Array],
    tiles: Tiles,
    lattice: Lattice,
    headings: int,
    count: int,
) -> Ranking:
    """The best of the tiles' best (`rank_tiles`), as poses in the map."""
    value, place = listed
    few, core = value.shape[1], tiles.core
    value, index = jax.lax.top_k(value.reshape(-1), min(count, value.size))
    tile, place = index // few, place.reshape(-1)[index]
    sector, row, column = jnp.unravel_index(place, (headings // _SECTOR, core, core))
    corner = tiles.corner[tile]
    position = lattice.to_map(corner[:, 0] + row, corner[:, 1] + column)
    score = jnp.floor(value / _SECTOR)
    heading = sector * _SECTOR + (value - score * _SECTOR).astype(int)
    turned = geometry.wrap(all_headings(headings)[heading, None] + lattice.frame[2])
    poses = jnp.concatenate([position, turned], axis=1)
    return Ranking(poses, score / _TICKS)


def all_headings(count: int) -> Float[Array, "count"]:
    """The headings that are tried, in the lattice's frame [rad]."""
    return -jnp.pi + 2 * jnp.pi * jnp.arange(count) / count


def scan_spectra(
    config: AtlasConfig, side: int, scan: Scan, headings: Float[Array, "some"]
) -> Complex[Array, "some side half_side"]:
    """Conjugate half-spectra of the images that a scan makes, turned by headings."""
    image = jax.vmap(lambda theta: _scan_image(config, side, scan, theta))
    return jnp.conj(jnp.fft.rfft2(image(headings)))


def _scan_image(config, side, scan, theta):
    """End points (and, negative, points inside the rays) splatted on the lattice.

    The heading theta is in the lattice's frame: a turned map is searched as it lies.
    """
    spacing, reach = config.spacing, config.reach
    near = scan.echo & (scan.ranges < reach)
    # Far walls are hit by few rays and say more about the heading: weight √r.
    weight = jnp.sqrt(jnp.clip(scan.ranges, 0.3, 10.0))
    weight = weight / jnp.maximum(jnp.sum(jnp.where(near, weight, 0.0)), 1e-6)
    direction = jnp.stack(
        [jnp.cos(theta + scan.bearings), jnp.sin(theta + scan.bearings)], axis=-1
    )
    at = direction * (jnp.minimum(scan.ranges, reach) / spacing)[:, None]
    corner = jnp.floor(at)
    u, v = (at - corner).T
    x, y, w = [], [], []
    for dx, share_x in ((0, 1 - u), (1, u)):
        for dy, share_y in ((0, 1 - v), (1, v)):
            x.append(corner[:, 0] + dx)
            y.append(corner[:, 1] + dy)
            w.append(jnp.where(near, share_x * share_y, 0.0) * weight)
    seen = jnp.minimum(scan.ranges, reach)
    for share in _THROUGH:
        probe = jnp.round(direction * (share * seen / spacing)[:, None])
        clear = scan.valid & ((1 - share) * seen > _CLEAR_OF_WALL)
        x.append(probe[:, 0])
        y.append(probe[:, 1])
        w.append(jnp.where(clear, -_THROUGH_WEIGHT / len(_THROUGH) * weight, 0.0))
    x, y = (jnp.concatenate(a).astype(jnp.int32) for a in (x, y))
    index = (y % side) * side + x % side
    image = jnp.zeros(side * side, scan.ranges.dtype).at[index].add(jnp.concatenate(w))
    return image.reshape(side, side)
