"""A map in square tiles: a campus is many small transforms and not one huge one.

The search correlates end points with the map's likelihood field. End points reach only
so far, so the field can be cut: a *core* of lattice nodes, and around it a *rim* as
wide as the reach. The circular correlation of such a tile is exact in its core,
wherever the map goes on beyond. Then

- the scan's images are transformed once and serve every tile;
- tiles where nobody can stand are never made, so corridors around a courtyard do not
  pay for the courtyard, and cost grows with the area, not faster;
- maps of all sizes meet one compiled program of a few tile sides and counts;
- tiles are independent: on many devices each takes its share (`sharding`).
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Complex, Int, ScalarLike, UInt8
from scipy import fft

from fsmsm_jax.localisation.lattice import Lattice
from fsmsm_jax.sensing.buckets import bucket
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["Cut", "Tiles", "cut", "likelihood_spectra", "mesh_of", "spread"]

_SIDES = (64, 80, 96, 128, 160, 192, 256)  # quick FFTs; larger ones leave the cache


class Tiles(eqx.Module):
    """The lattice's nodes, tile by tile."""

    spectra: Complex[Array, "tiles side half_side"]
    """Half-spectrum of each tile's likelihood field, rim included."""
    corner: Int[Array, "tiles 2"]
    """Row and column in the lattice of each core's first node."""
    allowed: Bool[Array, "tiles core core"]
    """Nodes where a sensor may stand."""
    shells: UInt8[Array, "tiles core core bins"]
    """Rays of each node's panorama by range (`shells`); zeros where none may stand."""

    @property
    def side(self) -> int:
        """Nodes along a tile, rim included."""
        return self.spectra.shape[-2]

    @property
    def core(self) -> int:
        """Nodes along a core."""
        return self.allowed.shape[-1]


def spread(arrays: Sequence[Array | np.ndarray], mesh: Mesh) -> Tiles:
    """Tiles shared out over the devices of a mesh, as evenly as they go.

    Args:
        arrays: of `Tiles`, in order. They may be mapped from a file: each process reads
            only what its own devices keep.
        mesh: devices; its shape does not matter.
    """
    mesh = Mesh(mesh.devices.reshape(-1), ("tiles",))
    sharding = NamedSharding(mesh, PartitionSpec("tiles"))
    spare = -len(arrays[0]) % mesh.size

    def share_out(array):
        host = np.asarray(array)
        if spare:
            host = np.pad(host, [(0, spare)] + [(0, 0)] * (host.ndim - 1))
        piece = lambda index: host[index]
        return jax.make_array_from_callback(host.shape, sharding, piece)

    return Tiles(*map(share_out, arrays))


def mesh_of(tiles: Tiles) -> Mesh | None:
    """The mesh that tiles are shared out over; None if they are on one device."""
    sharding = tiles.corner.sharding
    mesh = sharding.mesh if isinstance(sharding, NamedSharding) else None
    return mesh if isinstance(mesh, Mesh) else None


class Cut(NamedTuple):
    """Where the tiles of a lattice lie, before anything is computed."""

    side: int
    """Nodes along a tile, rim included."""
    rim: int
    """Nodes of the rim."""
    corner: Int[np.ndarray, "tiles 2"]
    """Row and column of each core's first node."""
    allowed: Bool[np.ndarray, "tiles core core"]
    """Nodes where a sensor may stand."""

    def bytes(self, bins: int) -> int:
        """What the tiles will hold, with so many shells a node."""
        number = np.dtype(jax.dtypes.canonicalize_dtype(complex)).itemsize
        spectrum = number * self.side * (self.side // 2 + 1)
        return len(self.corner) * (spectrum + 8) + self.allowed.size * (1 + bins)


def cut(allowed: Bool[np.ndarray, "rows columns"], reach: int) -> Cut:
    """Choose the side at which all tiles together are least work, and lay them out.

    Args:
        allowed: nodes where a sensor may stand, at least one.
        reach: how many nodes away an end point may lie.
    """
    rim = reach + 1  # an end point votes for the nodes around it
    sides = [side for side in _SIDES if side >= 3 * rim] or [_quick(4 * rim)]
    blocks = {side: _blocks(allowed, side - 2 * rim) for side in sides}
    work = lambda side: blocks[side].any(axis=(2, 3)).sum() * side**2
    side = min(sides, key=work)
    core, blocks = side - 2 * rim, blocks[side]
    used = np.argwhere(blocks.any(axis=(2, 3)))
    # Empty tiles up to a rounded number are skipped at run time, and spare compiling.
    spare = bucket(len(used)) - len(used)
    corner = np.pad(used * core, ((0, spare), (0, 0))).astype(np.int32)
    cores = np.pad(blocks[tuple(used.T)], ((0, spare), (0, 0), (0, 0)))
    return Cut(side, rim, corner, cores)


def _quick(side: int) -> int:
    length = fft.next_fast_len(side, real=True)
    assert length is not None  # scipy's stub says it may be
    return length


def _blocks(allowed, core):
    """(rows, columns) as (blocks, blocks, core, core)."""
    rows, columns = allowed.shape
    padded = np.pad(allowed, ((0, -rows % core), (0, -columns % core)))
    return padded.reshape(len(padded) // core, core, -1, core).swapaxes(1, 2)


@partial(jax.jit, static_argnames=("side", "rim"))
def likelihood_spectra(
    world: OccupancyGrid | PolygonMap,
    lattice: Lattice,
    size: Int[Array, "2"],
    corner: Int[Array, "tiles 2"],
    softness: ScalarLike,
    *,
    side: int,
    rim: int,
) -> Complex[Array, "tiles side half_side"]:
    """Half-spectra of exp(−d²/2σ²) over tiles, d the distance to the nearest wall.

    Args:
        world: the map.
        lattice: its lattice.
        size: rows and columns of it; beyond, the field is nought.
        corner: row and column of each core's first node.
        softness: σ [m].
        side: nodes along a tile, rim included.
        rim: nodes of the rim.
    """
    offset = jnp.arange(side) - rim

    def one(corner):
        along = corner[0] + offset, corner[1] + offset
        row, column = jnp.meshgrid(*along, indexing="ij")
        inside = (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
        distance = world.distance_at(lattice.to_map(row, column))
        field = jnp.exp(-0.5 * (distance / softness) ** 2)
        return jnp.fft.rfft2(jnp.where(inside, field, 0.0))

    return jax.lax.map(one, corner)
