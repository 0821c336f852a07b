"""Scanning a map from everywhere, once: how an atlas is made.

What it will cost is known before anything is cast, from the lattice alone, and a cap on
it is kept. Then the panoramas are cast chunk by chunk and forgotten: only their shells
stay, and go straight into the file if there is one.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from fsmsm_jax import geometry
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas, roomy, write_atlas
from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.localisation.shells import bins, shells
from fsmsm_jax.localisation.tiles import Cut, Tiles, cut, likelihood_spectra
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = ["build_atlas", "memory_estimate"]

_CHUNK = 1024  # positions cast together
_TRIES = 8  # of spacings, where a cap is too small


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
            return ScanAtlas(roomy(world), lattice, tiles, config)
        write_atlas(file, world, lattice, config, tiles, pieces)
    return ScanAtlas.load(file, world)


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
