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
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas
from fsmsm_jax.localisation.judge import CLEAR_OF_WALL, IN_THE_WAY, ON_THE_WAY
from fsmsm_jax.localisation.lattice import Lattice
from fsmsm_jax.localisation.shells import places_left, scan_shells
from fsmsm_jax.localisation.tiles import Tiles
from fsmsm_jax.sensing.lidar import Scan

__all__ = [
    "Box",
    "Ranking",
    "all_headings",
    "best_of_all",
    "rank_poses",
    "rank_tiles",
    "scan_spectra",
    "tiles_left",
]

_BLOCK = 0.8  # [m]: of the poses in a block and a sector only the best is listed, ...
_SECTOR = 24.0  # ... [deg]: a descent's basin, from whose middle it finds its way
_WHOLE = 1 << 23  # numbers up to it, and their halves, are told exactly in float32
_NOWHERE = -2.0  # score of a node where none may stand
_LEAST = -1.5  # others' at least: few echoes and long ways sum up to less


class Ranking(NamedTuple):
    """Lattice poses, best first."""

    poses: Float[Array, "count 3"]
    """Of the lidar in the map [m, m, rad]."""
    score: Float[Array, "count"]
    """At most 1; −2 where there were no more poses."""


class Box(NamedTuple):
    """Poses so near each other that the descent from one of them serves all."""

    headings: int
    """Neighbouring headings; a divisor of all."""
    nodes: int
    """Neighbouring rows and columns; a tile's last box may have fewer."""

    @classmethod
    def of(cls, spacing: float, headings: int) -> "Box":
        """The box of a lattice spacing [m] and a number of headings."""
        most = max(1, int(headings * _SECTOR / 360))
        sector = max(n for n in range(1, most + 1) if headings % n == 0)
        return cls(sector, max(1, round(_BLOCK / spacing)))

    def per_core(self, headings: int, core: int) -> tuple[int, int, int]:
        """How many boxes cover a core's headings, rows and columns."""
        side = -(-core // self.nodes)
        return headings // self.headings, side, side

    @property
    def ticks(self) -> int:
        """In which scores are told, so that a place in the box fits in beside them."""
        return _WHOLE // (self.headings * self.nodes**2)


def rank_poses(atlas: ScanAtlas, scan: Scan, headings: int, count: int) -> Ranking:
    """The best lattice poses for a scan, apart from each other, best first.

    Args:
        atlas: the map's atlas.
        scan: the real scan; echoes within the atlas's reach vote.
        headings: how many headings to try, an even number (static).
        count: how many poses to return at most (static). Of the poses in a `Box` only
            the best is listed.
    """
    tiles, config = atlas.tiles, atlas.config
    left = tiles_left(tiles, config, scan)
    spectra = scan_spectra(config, tiles.side, scan, all_headings(headings))
    box = Box.of(config.spacing, headings)
    listed = rank_tiles(tiles.spectra, left, spectra, box, count)
    return best_of_all(listed, tiles, atlas.lattice, headings, box, count)


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
    box: Box,
    count: int,
) -> tuple[Float[Array, "tiles few"], Int[Array, "tiles few"]]:
    """Each tile's best: score and place in the box in one number, and which box.

    Args:
        tiles: spectra of the likelihood field.
        left: nodes that are not ruled out; a tile without any is skipped.
        scan: conjugate spectra of the scan's images.
        box: of which only the best is listed.
        count: how many to list, at most.
    """
    headings, side, _ = scan.shape
    core = left.shape[-1]
    rim = (side - core) // 2
    boxes = box.per_core(headings, core)
    few = min(count, int(np.prod(boxes)))
    shape = tuple(np.stack([boxes, (box.headings, box.nodes, box.nodes)], 1).ravel())

    def correlate(spectrum, left):
        score = jnp.fft.irfft2(scan * spectrum[None], s=(side, side))
        score = score[:, rim : rim + core, rim : rim + core]
        score = jnp.where(left[None], jnp.maximum(score, _LEAST), _NOWHERE)
        fill = (0, boxes[1] * box.nodes - core)
        score = jnp.pad(score, ((0, 0), fill, fill), constant_values=_NOWHERE)
        # One whole number holds score and place, for XLA's argmax is slow on the CPU;
        # a float, for its top_k sorts everything if it is given integers.
        score = jnp.round(score.reshape(shape) * box.ticks)
        places = box.headings * box.nodes**2
        place = jnp.arange(places, dtype=score.dtype)
        place = place.reshape(1, box.headings, 1, box.nodes, 1, box.nodes)
        best = (score * places + place).max(axis=(1, 3, 5))
        return tuple(jax.lax.top_k(best.reshape(-1), few))

    def skip(spectrum, left):
        nothing = _NOWHERE * box.ticks * box.headings * box.nodes**2
        return jnp.full(few, nothing, scan.real.dtype), jnp.zeros(few, jnp.int32)

    one = lambda tile: jax.lax.cond(jnp.any(tile[1]), correlate, skip, *tile)
    return jax.lax.map(one, (tiles, left))


def best_of_all(
    listed: tuple[Array, Array],
    tiles: Tiles,
    lattice: Lattice,
    headings: int,
    box: Box,
    count: int,
) -> Ranking:
    """The best of the tiles' best (`rank_tiles`), as poses in the map."""
    value, which = listed
    few, core = value.shape[1], tiles.core
    value, index = jax.lax.top_k(value.reshape(-1), min(count, value.size))
    tile, which = index // few, which.reshape(-1)[index]
    places = box.headings * box.nodes**2
    score = jnp.floor(value / places)
    place = (value - score * places).astype(int)
    first = jnp.unravel_index(which, box.per_core(headings, core))
    inside = jnp.unravel_index(place, (box.headings, box.nodes, box.nodes))
    heading = first[0] * box.headings + inside[0]
    row, column = (first[n] * box.nodes + inside[n] for n in (1, 2))
    corner = tiles.corner[tile]
    position = lattice.to_map(corner[:, 0] + row, corner[:, 1] + column)
    turned = geometry.wrap(all_headings(headings)[heading, None] + lattice.frame[2])
    poses = jnp.concatenate([position, turned], axis=1)
    return Ranking(poses, score / box.ticks)


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
    for share in ON_THE_WAY:
        probe = jnp.round(direction * (share * seen / spacing)[:, None])
        clear = scan.valid & ((1 - share) * seen > CLEAR_OF_WALL)
        x.append(probe[:, 0])
        y.append(probe[:, 1])
        w.append(jnp.where(clear, -IN_THE_WAY / len(ON_THE_WAY) * weight, 0.0))
    x, y = (jnp.concatenate(a).astype(jnp.int32) for a in (x, y))
    index = (y % side) * side + x % side
    image = jnp.zeros(side * side, scan.ranges.dtype).at[index].add(jnp.concatenate(w))
    return image.reshape(side, side)
