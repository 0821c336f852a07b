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
Building is chunked; what it will cost is said before (`memory_estimate`), and a cap on
it is kept.
"""

import dataclasses
import hashlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

from fsmsm_jax import geometry
from fsmsm_jax.localisation.array_file import UNREADABLE, read_arrays, write_arrays
from fsmsm_jax.localisation.lattice import Lattice, lattice_over
from fsmsm_jax.localisation.shells import bins, shells
from fsmsm_jax.localisation.tiles import Cut, Tiles, cut, likelihood_spectra, spread
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "AtlasConfig",
    "ScanAtlas",
    "build_atlas",
    "memory_estimate",
]

_CHUNK = 1024  # positions cast together
_VERSION = 2  # of the file; 1 held spectra of panoramas, and no tiles
_OF_TILES = ("spectra", "corner", "allowed", "shells")
_TRIES = 8  # of spacings, where a cap is too small


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
        _write(path, self.world, self.lattice, self.config, tiles, pieces)

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
            world=_roomy(world),
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


def memory_estimate(
    world: OccupancyGrid | PolygonMap, config: AtlasConfig = AtlasConfig()
) -> int:
    """Bytes that the atlas of this world will hold, without building it."""
    _, allowed = lattice_over(world, config.spacing, config.margin)
    return _cut(allowed, config).bytes(bins(config.reach))


def build_atlas(
    world: OccupancyGrid | PolygonMap,
    config: AtlasConfig = AtlasConfig(),
    *,
    max_memory: float = np.inf,
    progress: bool = False,
    file: str | Path | None = None,
) -> ScanAtlas:
    """Scan the map from every lattice position.

    Args:
        world: the map.
        config: how finely.
        max_memory: bytes that the atlas may hold, the map itself not counted.
        progress: whether to draw a progress bar on stderr.
        file: where to write the atlas while it is made, for one that would not fit
            into memory twice; None to make it in memory, and `save` or not.

    Raises:
        ValueError: no lattice position lies in free space, or the atlas would be larger
            than it may (said before anything is cast, with the spacing that would fit).

    Example:
        >>> import fsmsm_jax as fj
        >>> room = fj.PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> atlas = build_atlas(room, AtlasConfig(spacing=0.5, margin=0.0))
        >>> int(atlas.tiles.allowed.sum())  # positions
        48
    """
    lattice, allowed = lattice_over(world, config.spacing, config.margin)
    layout = _cut(allowed, config)
    cost = layout.bytes(bins(config.reach))
    if cost > max_memory:
        fits = _spacing_that_fits(world, config, cost, max_memory)
        raise ValueError(
            f"the atlas of spacing {config.spacing:g} m needs {cost / 1e6:.1f} MB and "
            f"may have {max_memory / 1e6:.1f} MB; {fits}"
        )
    corner, size = jnp.asarray(layout.corner), jnp.asarray(allowed.shape)
    spectra = likelihood_spectra(
        world, lattice, size, corner, config.softness, side=layout.side, rim=layout.rim
    )
    tiles = {
        "spectra": spectra,
        "corner": corner,
        "allowed": jnp.asarray(layout.allowed),
    }
    positions = int(layout.allowed.sum())
    label = f"atlas of {positions} positions, {cost / 1e6:.0f} MB"
    with tqdm(total=positions, desc=label, disable=not progress) as bar:
        pieces = (
            _shells_of(world, lattice, *tile, config, bar)
            for tile in zip(layout.corner, layout.allowed, strict=True)
        )
        if file is None:
            told = jnp.asarray(np.concatenate(list(pieces)))
            tiles = Tiles(**tiles, shells=told)
            return ScanAtlas(_roomy(world), lattice, tiles, config)
        _write(file, world, lattice, config, tiles, pieces)
    return ScanAtlas.load(file, world)


def _roomy(world):
    """The map in arrays of rounded sizes, so that maps share compiled programs."""
    return world.padded() if isinstance(world, OccupancyGrid) else world


def _write(path, world, lattice, config, tiles, pieces):
    """The file of an atlas, of which the tiles' shells come in pieces."""
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


def _shells_of(world, lattice, corner, allowed, config, bar):
    """Shells of one tile's nodes (1, core, core, bins), cast chunk by chunk."""
    row, column = np.nonzero(allowed)
    found = np.zeros((1, *allowed.shape, bins(config.reach)), np.uint8)
    for start in range(0, len(row), _CHUNK):
        here = slice(start, start + _CHUNK)
        count = len(row[here])
        nodes = np.stack([row[here], column[here]]) + corner[:, None]
        nodes = np.pad(nodes, ((0, 0), (0, _CHUNK - count)), mode="edge")
        seen = _shells_from(world, lattice.frame, nodes, config)
        found[0, row[here], column[here]] = np.asarray(seen)[:count]
        bar.update(count)
    return found


@jax.jit
def _shells_from(world, frame, nodes, config):
    offset = (nodes[::-1].T + 0.5) * config.spacing
    poses = jnp.pad(geometry.transform_points(frame, offset), ((0, 0), (0, 1)))
    bearings = -jnp.pi + 2 * jnp.pi * jnp.arange(config.rays) / config.rays
    # A little beyond the reach, so that what is at the limit is in no shell.
    cast = lambda pose: raycast(world, pose, bearings, config.reach + 1.0)
    return jax.vmap(lambda pose: shells(cast(pose), config.reach))(poses)


def _cut(allowed, config) -> Cut:
    return cut(allowed, int(np.ceil(config.reach / config.spacing)))


def _spacing_that_fits(world, config, size, allowed) -> str:
    """What to do about an atlas that is too large: its bytes go with 1 / spacing²."""
    spacing = config.spacing
    for _ in range(_TRIES):
        wider = spacing * max(1.05, 1.02 * np.sqrt(size / max(allowed, 1)))
        spacing = float(np.ceil(100 * wider) / 100)  # up, or fine ones stay as they are
        coarser = dataclasses.replace(config, spacing=spacing)
        try:
            size = memory_estimate(world, coarser)
        except ValueError:  # no position left
            break
        if size <= allowed:
            return f"a spacing of {spacing:g} m would fit, with {size / 1e6:.1f} MB"
    return "no spacing would fit; try a shorter reach, or more memory"


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
