"""End points against the whole map: all positions and headings, by the DFT.

A pose is good when the scan's end points fall on walls. With L the map's likelihood
field and p_i the end points turned by a heading, the score of every position x,

    S(x) = Σ_i w_i L(x + p_i),

is one cross-correlation: the product of the map's spectrum with the conjugate
spectrum of the image that the end points make. So a whole map costs two FFTs a
heading, whatever the number of positions, and loses nothing to a brute-force search
on the same lattice. Points *inside* the rays enter with negative weight: space the
sensor looked through should not lie on a wall.

(E. Olson, "Real-time correlative scan matching", ICRA 2009, does the sums; the DFT
does them all at once.)
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from fsmsm_jax import geometry
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.sensing.lidar import Scan

__all__ = ["rank_poses"]

_THROUGH = (0.3, 0.55, 0.8)  # where along a ray its free space is probed
_THROUGH_WEIGHT = 0.5  # of all probes of a ray, against its end point's 1
_CLEAR_OF_WALL = 0.75  # [m] probes nearer to the end point would blur into its wall
_SECTOR = 6  # neighbouring headings of which only the best is kept
_BLOCK = 2  # neighbouring rows and columns of which only the best is kept


def rank_poses(
    atlas: ScanAtlas, scan: Scan, headings: int, count: int
) -> tuple[Float[Array, "count 3"], Int[Array, "count"], Float[Array, "count"]]:
    """The best lattice poses for a scan, apart from each other, best first.

    Args:
        atlas: the map's atlas.
        scan: the real scan; echoes within the atlas's reach vote.
        headings: how many headings to try, a multiple of 6 (static).
        count: how many poses to return at most (static).

    Returns:
        Poses of the lidar in the map; the index of each into `atlas.panoramas`; the
        scores, at most 1. Of 6 neighbouring headings and 2 × 2 positions only the
        best is listed.
    """
    lattice = atlas.lattice
    rows, columns = lattice.allowed.shape
    theta = -jnp.pi + 2 * jnp.pi * jnp.arange(headings) / headings
    pad = ((0, 0), (0, -rows % _BLOCK), (0, -columns % _BLOCK))

    def best_of_sector(theta):
        image = jax.vmap(lambda t: _scan_image(atlas, scan, t))(theta)
        spectrum = jnp.conj(jnp.fft.rfft2(image)) * atlas.end_points[None]
        score = jnp.fft.irfft2(spectrum, s=atlas.padded_shape)[:, :rows, :columns]
        score = jnp.where(lattice.allowed[None], score, -2.0)
        score = jnp.pad(score, pad, constant_values=-2.0)
        # One integer holds score and place, for XLA's argmax is slow on the CPU.
        ticks = jnp.round(score * (1 << 20)).astype(jnp.int32) << 5
        k, i, j = (jnp.arange(n) for n in score.shape)
        k, i, j = k[:, None, None], i[None, :, None], j[None, None, :]
        place = (k * _BLOCK + i % _BLOCK) * _BLOCK + j % _BLOCK
        blocks = (ticks + place).reshape(
            _SECTOR, score.shape[1] // _BLOCK, _BLOCK, score.shape[2] // _BLOCK, _BLOCK
        )
        return blocks.max(axis=(0, 2, 4))

    best = jax.lax.map(best_of_sector, theta.reshape(-1, _SECTOR))
    count = min(count, best.size)
    value, index = jax.lax.top_k(best.reshape(-1), count)
    sector, row, column = jnp.unravel_index(index, best.shape)
    place = value & 31
    heading = sector * _SECTOR + place // _BLOCK**2
    row = jnp.minimum(row * _BLOCK + place // _BLOCK % _BLOCK, rows - 1)
    column = jnp.minimum(column * _BLOCK + place % _BLOCK, columns - 1)
    position = lattice.to_map(row, column)
    turned = geometry.wrap(theta[heading, None] + lattice.frame[2])
    poses = jnp.concatenate([position, turned], axis=1)
    return poses, atlas.row_of[row, column], (value >> 5) / (1 << 20)


def _scan_image(atlas, scan, theta):
    """End points (and, negative, points inside the rays) splatted on the lattice.

    The heading theta is in the lattice's frame: a turned map is searched as it lies.
    """
    spacing, reach = atlas.config.spacing, atlas.config.reach
    near = scan.echo & (scan.ranges < reach)
    # Far walls are hit by few rays and say more about the heading: weight √r.
    weight = jnp.sqrt(jnp.clip(scan.ranges, 0.3, 10.0))
    weight = weight / jnp.maximum(jnp.sum(jnp.where(near, weight, 0.0)), 1e-6)
    direction = jnp.stack(
        [jnp.cos(theta + scan.bearings), jnp.sin(theta + scan.bearings)], axis=-1
    )
    at = direction * (scan.ranges / spacing)[:, None]
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
    height, width = atlas.padded_shape
    x, y = (jnp.concatenate(a).astype(jnp.int32) for a in (x, y))
    index = (y % height) * width + x % width
    image = (
        jnp.zeros(height * width, scan.ranges.dtype).at[index].add(jnp.concatenate(w))
    )
    return image.reshape(height, width)
