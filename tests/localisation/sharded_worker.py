"""A process of `test_sharding`: localises the same scans, on the devices it is told.

`python -m tests.localisation.sharded_worker TASK FOLDER [PROCESS PORT]` reads the atlas
and the scans in the folder and writes what it found beside them. The number of devices
is fixed when a process starts, and one that is joined to another may well be killed:
hence processes of their own.
"""

import os
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from fsmsm_jax.localisation import ScanAtlas, SearchConfig, localise, localise_batch
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import PolygonMap
from tests.worlds import CENTRE

LIMIT = 10
"""Seconds after which a joined process that is silent, or done too early, is given up."""
GONE = 3
"""Exit status of a process that dies as it is told."""
QUICK = SearchConfig(60, ranked=256, descended=32, polished=8, reported=8)


def room() -> PolygonMap:
    """L-shaped, 9 m by 9 m, away from the origin."""
    corners = [[-3, -1.5], [6, -1.5], [6, 2.25], [1.5, 2.25], [1.5, 7.5], [-3, 7.5]]
    return PolygonMap.from_outlines(np.array(corners) + CENTRE)


def mesh_of(*shape: int) -> Mesh:
    """The first devices there are."""
    devices = np.array(jax.devices()[: np.prod(shape)]).reshape(shape)
    return Mesh(devices, [f"axis_{n}" for n in range(len(shape))])


def scans_in(folder: Path) -> Scan:
    with np.load(folder / "scans.npz") as kept:
        return Scan(*(jnp.asarray(kept[name]) for name in Scan.__annotations__))


def part(scans: Scan, index: int) -> Scan:
    return jax.tree.map(lambda leaf: leaf[index], scans)


def one_by_one(atlas: ScanAtlas, scans: Scan):
    found = [localise(atlas, part(scans, n), QUICK) for n in range(len(scans.ranges))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def write(folder: Path, name: str, found) -> None:
    poses, scores = found.candidates[:2]
    sure = found.confident
    np.savez(folder / f"{name}.npz", poses=poses, scores=scores, confident=sure)


def alone(folder: Path) -> None:
    """On one device, as ever."""
    assert len(jax.devices()) == 1
    atlas = ScanAtlas.load(folder / "atlas.npz", room())
    write(folder, "alone", one_by_one(atlas, scans_in(folder)))


def eight(folder: Path) -> None:
    """Over all of eight devices, over three of them, and over a mesh of two axes."""
    assert len(jax.devices()) == 8
    scans, world, path = scans_in(folder), room(), folder / "atlas.npz"
    whole = ScanAtlas.load(path, world)
    spread = whole.spread(mesh_of(8))
    write(folder, "eight", one_by_one(spread, scans))
    write(folder, "eight_batch", localise_batch(spread, scans, QUICK))
    write(folder, "three", one_by_one(whole.spread(mesh_of(3)), scans))
    loaded = ScanAtlas.load(path, world, mesh=mesh_of(4, 2))
    write(folder, "four_by_two", one_by_one(loaded, scans))
    pieces = [spread.tiles, loaded.tiles, whole.spread(mesh_of(3)).tiles]
    held = [[len(s.data) for s in p.spectra.addressable_shards] for p in pieces]
    np.savez(folder / "held.npz", *map(np.asarray, held))


def pair(folder: Path, process: int, fate: str) -> None:
    """With another process; the second of them ends by its fate, the first goes on."""
    assert len(jax.devices()) == 4
    assert len(jax.local_devices()) == 2
    scans = scans_in(folder)
    atlas = ScanAtlas.load(folder / "atlas.npz", room(), mesh=mesh_of(4))
    if fate == "later":
        write(folder, f"pair_{process}", one_by_one(atlas, scans))
    if process == 1:
        if fate == "raises":
            raise RuntimeError("as it was told")
        os._exit(GONE)
    localise(atlas, part(scans, 0), QUICK)
    (folder / "went_on").touch()


def main() -> None:
    task, folder = sys.argv[1], Path(sys.argv[2])
    if task in ("alone", "eight"):
        return {"alone": alone, "eight": eight}[task](folder)
    process, port = map(int, sys.argv[3:])
    jax.distributed.initialize(
        f"127.0.0.1:{port}",
        num_processes=2,
        process_id=process,
        heartbeat_timeout_seconds=LIMIT,
        shutdown_timeout_seconds=LIMIT,
    )
    pair(folder, process, task)


if __name__ == "__main__":
    main()
