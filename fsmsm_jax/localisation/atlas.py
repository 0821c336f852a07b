"""The map is scanned once, not once per query.

A `ScanAtlas` lays a square lattice over the map's free space and keeps, of each
position, the panoramic scan that a lidar would take there. Turning the sensor only
shifts that scan, so one panorama stands for all headings: hypotheses are positions.

Two spectra make a query a handful of FFTs:

- `end_points`: the two-dimensional DFT of the map's likelihood field
  exp(−d²/2σ²), d being the distance to the nearest wall. The product with the
  spectrum of the scan's end points scores *every* lattice position at one heading.
- `panoramas`: the one-dimensional DFTs of the panoramas, their ranges written as
  phases e^{iω log(r + r₀)}. The product with the real panorama's spectrum scores
  *every* heading at one position. As a phase each ray has weight one: a long ray
  cannot outvote fifty short ones, as it does when metres are correlated.

Building is chunked; what it will cost is said before (`memory_estimate`).
"""

import hashlib
import zipfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int
from scipy import fft
from tqdm import tqdm

from fsmsm_jax.localisation.lattice import Lattice, lattice_over
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "AtlasConfig",
    "ScanAtlas",
    "build_atlas",
    "memory_estimate",
    "range_phases",
]

_FREQUENCY = 4.0  # ω: ranges that differ by a factor of two differ by 2.8 rad
_OFFSET = 0.3  # r₀ [m]: below this, differences of range are clutter
_CHUNK = 1024  # positions cast together
_UNREADABLE = (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile)


class AtlasConfig(eqx.Module):
    """How finely the map is scanned."""

    spacing: float = eqx.field(static=True, default=0.4)
    """Distance between lattice positions [m]."""
    rays: int = eqx.field(static=True, default=180)
    """Rays of each panorama."""
    range_max: float = eqx.field(static=True, default=30.0)
    """Longest range of the panoramas [m]."""
    reach: float = eqx.field(static=True, default=15.0)
    """End points farther than this from the sensor do not vote in the search [m]."""
    softness: float = eqx.field(static=True, default=0.35)
    """σ of the likelihood field [m]: about a spacing, so that no wall slips through."""
    margin: float = eqx.field(static=True, default=1.0)
    """How far into unknown space a sensor may stand [m]."""

    def __check_init__(self):
        """Refuse settings that no lattice can be built with."""
        for name in ("spacing", "range_max", "reach", "softness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive length [m], got {value}")
        if self.rays < 8 or not self.margin >= 0:
            raise ValueError(
                f"expected rays ≥ 8 and margin ≥ 0, got {self.rays} and {self.margin}"
            )


class ScanAtlas(eqx.Module):
    """A map scanned from a lattice of positions; build one with `build_atlas`."""

    world: OccupancyGrid | PolygonMap
    """The map itself."""
    lattice: Lattice
    """Where the map was scanned from."""
    row_of: Int[Array, "rows columns"]
    """Index into `panoramas` of each node; of a neighbour where none may stand."""
    panoramas: Complex[Array, "positions rays"]
    """DFT of each panorama's e^{iω log(r + r₀)}, ray n at bearing −π + 2πn/rays."""
    end_points: Complex[Array, "height half_width"]
    """Half-spectrum of the zero-padded likelihood field."""
    config: AtlasConfig = eqx.field(static=True)

    @property
    def padded_shape(self) -> tuple[int, int]:
        """Size of the field whose spectrum `end_points` is."""
        return _padded_shape(self.lattice.allowed.shape, self.config)

    def save(self, path: str | Path) -> None:
        """Write the atlas, less the map it belongs to, as an `.npz` file."""
        with Path(path).open("wb") as file:
            np.savez(
                file,
                fingerprint=np.asarray(_fingerprint(self.world)),
                frame=self.lattice.frame,
                allowed=self.lattice.allowed,
                panoramas=self.panoramas,
                end_points=self.end_points,
                **{  # pyright: ignore[reportArgumentType]: keyword names, not options
                    f"config_{name}": np.asarray(value)
                    for name, value in vars(self.config).items()
                },
            )

    @classmethod
    def load(cls, path: str | Path, world: OccupancyGrid | PolygonMap) -> "ScanAtlas":
        """Read an atlas that was saved for this very map.

        Raises:
            ValueError: the file is missing or no atlas, or was built for another map.
        """
        names = list(AtlasConfig.__dataclass_fields__)
        try:
            with Path(path).open("rb") as file, np.load(file) as saved:
                fingerprint = str(saved["fingerprint"])
                config = AtlasConfig(**{k: saved[f"config_{k}"].item() for k in names})
                arrays = {
                    k: saved[k] for k in ("frame", "allowed", "panoramas", "end_points")
                }
        except _UNREADABLE as error:
            raise ValueError(
                f"cannot read a scan atlas from {path} ({error}); "
                "build it anew with build_atlas(world) and save it"
            ) from error
        expected = (int(arrays["allowed"].sum()), config.rays)
        if arrays["panoramas"].shape != expected:
            raise ValueError(
                f"the atlas {path} is damaged: expected panoramas of shape {expected}, "
                f"got {arrays['panoramas'].shape}; build it anew with build_atlas"
            )
        if fingerprint != _fingerprint(world):
            raise ValueError(
                f"the atlas {path} was built for another map, or other settings of it; "
                "load that map, or build a new atlas for this one with build_atlas"
            )
        lattice = Lattice(
            jnp.asarray(arrays["frame"]), jnp.asarray(arrays["allowed"]), config.spacing
        )
        return cls(
            world=world,
            lattice=lattice,
            row_of=_row_of(arrays["allowed"]),
            panoramas=jnp.asarray(arrays["panoramas"]),
            end_points=jnp.asarray(arrays["end_points"]),
            config=config,
        )


def memory_estimate(
    world: OccupancyGrid | PolygonMap, config: AtlasConfig = AtlasConfig()
) -> int:
    """Bytes that the atlas of this world will hold, without building it."""
    return _bytes(lattice_over(world, config.spacing, config.margin), config)


def build_atlas(
    world: OccupancyGrid | PolygonMap,
    config: AtlasConfig = AtlasConfig(),
    *,
    progress: bool = False,
) -> ScanAtlas:
    """Scan the map from every lattice position.

    Args:
        world: the map.
        config: how finely.
        progress: whether to draw a progress bar on stderr.

    Raises:
        ValueError: no lattice position lies in free space.

    Example:
        >>> import fsmsm_jax as fj
        >>> room = fj.PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [1, 4]])
        >>> atlas = build_atlas(room, AtlasConfig(spacing=0.5, margin=0.0))
        >>> atlas.panoramas.shape
        (48, 180)
    """
    lattice = lattice_over(world, config.spacing, config.margin)
    position = lattice.positions[lattice.allowed]
    count = len(position)
    padded = jnp.pad(position, ((0, -count % _CHUNK), (0, 0)), mode="edge")
    cost = f"atlas of {count} positions, {_bytes(lattice, config) / 1e6:.0f} MB"
    batches = tqdm(
        jnp.split(padded, len(padded) // _CHUNK), desc=cost, disable=not progress
    )
    panoramas = [_panoramas_from(world, batch, config) for batch in batches]
    return ScanAtlas(
        world=world,
        lattice=lattice,
        row_of=_row_of(np.asarray(lattice.allowed)),
        panoramas=jnp.concatenate(panoramas)[:count],
        end_points=_end_point_spectrum(world, lattice, config),
        config=config,
    )


@jax.jit
def _panoramas_from(world, positions, config):
    """Spectra of the panoramas seen from a chunk of positions."""
    bearings = -jnp.pi + 2 * jnp.pi * jnp.arange(config.rays) / config.rays
    poses = jnp.pad(positions, ((0, 0), (0, 1)))
    cast = lambda pose: raycast(world, pose, bearings, config.range_max)
    return jnp.fft.fft(range_phases(jax.vmap(cast)(poses)))


def range_phases(ranges: Float[Array, "*batch rays"]) -> Complex[Array, "*batch rays"]:
    """Ranges [m] as unit phases e^{iω log(r + r₀)}: every ray has the same vote."""
    return jnp.exp(1j * _FREQUENCY * jnp.log(ranges + _OFFSET))


@jax.jit
def _end_point_spectrum(world, lattice, config):
    """Half-spectrum of exp(−d²/2σ²) at the lattice's nodes."""
    distance = world.distance_at(lattice.positions)
    likelihood = jnp.exp(-0.5 * (distance / config.softness) ** 2)
    return jnp.fft.rfft2(likelihood, s=_padded_shape(likelihood.shape, config))


def _bytes(lattice, config) -> int:
    """Size of the two spectra: eight bytes a complex number."""
    height, width = _padded_shape(lattice.allowed.shape, config)
    positions = int(lattice.allowed.sum())
    return 8 * (positions * config.rays + height * (width // 2 + 1))


def _padded_shape(shape, config) -> tuple[int, int]:
    """Room beyond the map, rounded up to lengths that FFTs like.

    The correlation is circular: end points farther than this off the map come round
    to its other side. Half the reach is enough, for a right pose has none out there.
    """
    reach = int(np.ceil(0.5 * config.reach / config.spacing)) + 2
    rows, columns = (fft.next_fast_len(n + reach, real=True) for n in shape)
    return rows, columns  # pyright: ignore[reportReturnType]: scipy's stub says None


def _row_of(allowed):
    return jnp.asarray(np.maximum(np.cumsum(allowed) - 1, 0).reshape(allowed.shape))


def _fingerprint(world) -> str:
    """A digest of everything in the world that a virtual scan depends on."""
    digest = hashlib.sha256(type(world).__name__.encode())
    for leaf in jax.tree.leaves(world):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
