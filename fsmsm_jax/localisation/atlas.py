"""The map is scanned once, not once per query.

A `ScanAtlas` lays a square lattice over the map's free space and takes a panoramic scan
from each position. Turning the sensor only shifts that scan, so one panorama stands for
all headings: hypotheses are positions. Of map and panoramas it keeps what makes a query
a handful of FFTs:

- `tiles.spectra`: two-dimensional DFTs of the map's likelihood field exp(−d²/2σ²), d
  being the distance to the nearest wall. The product with the spectrum of the scan's
  end points scores *every* lattice position at one heading (`correlative`).
- `tiles.shells`: how many rays of each panorama end how far away, a byte each. That
  does not change when the sensor turns, and rules places out before anything is
  correlated (`shells`).

The lattice is coarse; what survives on it descends on the map itself (`search`).
`atlas_build` makes one.
"""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, UInt8

from fsmsm_jax.localisation.array_file import UNREADABLE, read_arrays, write_arrays
from fsmsm_jax.localisation.lattice import Lattice
from fsmsm_jax.localisation.shells import bins
from fsmsm_jax.localisation.tiles import Tiles, spread
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["AtlasConfig", "ScanAtlas", "roomy", "write_atlas"]

_VERSION = 2  # of the file; 1 held spectra of panoramas, and no tiles
_OF_TILES = ("spectra", "corner", "allowed", "shells")


class AtlasConfig(eqx.Module):
    """How finely the map is scanned."""

    spacing: float = eqx.field(static=True, default=0.8)
    """Distance between lattice positions [m]."""
    rays: int = eqx.field(static=True, default=180)
    """Rays of each panorama, 255 at most."""
    reach: float = eqx.field(static=True, default=15.0)
    """End points farther than this from the sensor do not vote in the search [m]."""
    softness: float = eqx.field(static=True, default=0.5)
    """σ of the likelihood field [m]: about a spacing, so that no wall slips through."""
    margin: float = eqx.field(static=True, default=1.0)
    """How far into unknown space a sensor may stand [m]."""

    def __check_init__(self):
        """Refuse settings that no lattice can be built with."""
        for name in ("spacing", "reach", "softness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive length [m], got {value}")
        if not 8 <= self.rays <= 255 or not self.margin >= 0:
            raise ValueError(
                "expected 8 ≤ rays ≤ 255 and margin ≥ 0, got "
                f"{self.rays} and {self.margin}"
            )


class ScanAtlas(eqx.Module):
    """A map scanned from a lattice of positions; build one with `build_atlas`."""

    world: OccupancyGrid | PolygonMap
    """The map itself."""
    lattice: Lattice
    """Where the map was scanned from."""
    tiles: Tiles
    """What is known of each position, and of the walls around."""
    config: AtlasConfig = eqx.field(static=True)

    def save(self, path: str | Path) -> None:
        """Write the atlas, less the map it belongs to, as an `.npz` file."""
        tiles = {name: getattr(self.tiles, name) for name in _OF_TILES}
        pieces = [np.asarray(tiles.pop("shells"))]
        write_atlas(path, self.world, self.lattice, self.config, tiles, pieces)

    @classmethod
    def load(
        cls,
        path: str | Path,
        world: OccupancyGrid | PolygonMap,
        mesh: Mesh | None = None,
    ) -> "ScanAtlas":
        """Read an atlas that was saved for this very map.

        Args:
            path: the file.
            world: the map.
            mesh: devices to spread it over; on one device if left out.

        Raises:
            ValueError: the file is missing, no atlas, torn or changed, of another
                version, or was built for another map.
        """
        anew = "build it anew with build_atlas(world) and save it"
        try:
            kept = read_arrays(Path(path))
            version = int(kept["version"]) if "version" in kept else 1
            if version != _VERSION:
                raise ValueError(f"it is of version {version}, not {_VERSION}")
            names = AtlasConfig.__dataclass_fields__
            config = AtlasConfig(**{k: kept[f"config_{k}"].item() for k in names})
            fingerprint = str(kept["fingerprint"])
            lattice = Lattice(jnp.asarray(kept["frame"]), config.spacing)
            tiles = [kept[name] for name in _OF_TILES]
            *_, allowed, told = (array.shape for array in tiles)
            if told != (*allowed, bins(config.reach)) or (
                {len(array) for array in tiles} != {allowed[0]}
            ):
                raise ValueError("its arrays do not fit together")
        except UNREADABLE as error:
            raise ValueError(
                f"cannot read a scan atlas from {path} ({error}); {anew}"
            ) from error
        if fingerprint != _fingerprint(world):
            raise ValueError(
                f"the atlas {path} was built for another map, or other settings of it; "
                "load that map, or build a new atlas for this one with build_atlas"
            )
        return cls(
            world=roomy(world),
            lattice=lattice,
            tiles=spread(tiles, mesh) if mesh else Tiles(*map(jnp.asarray, tiles)),
            config=config,
        )

    def spread(self, mesh: Mesh) -> "ScanAtlas":
        """The same atlas with its tiles shared out over the devices of a mesh.

        `localise` is called as before. With several processes each makes or loads the
        atlas, spreads it over a mesh of all devices, and calls `localise` with the same
        scans in the same order; the map itself stays on each process's first device.

        Example, of two processes; join before anything else of JAX is used:
            jax.distributed.initialize("host:1234", num_processes=2, process_id=n,
                heartbeat_timeout_seconds=10, shutdown_timeout_seconds=30)

        If a process crashes, the next `localise` of the others raises, or they are
        ended after the first limit; if one raises and ends, after the second. JAX's
        own limits are 100 s and 300 s.
        """
        tiles = spread(jax.tree.leaves(self.tiles), mesh)
        return eqx.tree_at(lambda atlas: atlas.tiles, self, tiles)

    @property
    def nbytes(self) -> int:
        """What it holds beside the map [bytes]."""
        return sum(a.nbytes for a in jax.tree.leaves(self.tiles))


def roomy(world: OccupancyGrid | PolygonMap) -> OccupancyGrid | PolygonMap:
    """The map in arrays of rounded sizes, so that maps share compiled programs."""
    return world.padded() if isinstance(world, OccupancyGrid) else world


def write_atlas(
    path: str | Path,
    world: OccupancyGrid | PolygonMap,
    lattice: Lattice,
    config: AtlasConfig,
    tiles: Mapping[str, Array],
    pieces: Iterable[UInt8[np.ndarray, "some core core bins"]],
) -> None:
    """The file of an atlas.

    Args:
        path: the file to write.
        world: the map, as it was loaded; the file holds a fingerprint of it.
        lattice: where it was scanned from.
        config: how finely.
        tiles: the fields of `Tiles` but the shells.
        pieces: the shells, tile by tile or many at once, as they are made.
    """
    small = {
        "version": _VERSION,
        "fingerprint": _fingerprint(world),
        **{f"config_{name}": value for name, value in vars(config).items()},
        "frame": lattice.frame,
        **tiles,
    }
    small = {name: np.asarray(value) for name, value in small.items()}
    shape = *small["allowed"].shape, bins(config.reach)
    write_arrays(Path(path), small, "shells", shape, np.dtype(np.uint8), pieces)


def _fingerprint(world) -> str:
    """A digest of everything in the world that a virtual scan depends on."""
    digest = hashlib.sha256(type(world).__name__.encode())
    if isinstance(world, OccupancyGrid):  # the other fields follow from these
        rows, columns = (int(side) for side in world.extent)  # whether padded or not
        clearance = np.asarray(world.clearance)[: rows + 2, : columns + 2]
        cells = np.asarray(world.cells)[:rows, :columns]
        told = (cells, world.resolution, world.origin, clearance)
    else:
        told = (world.start, world.end, world.solid)
    for leaf in jax.tree.leaves(told):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
