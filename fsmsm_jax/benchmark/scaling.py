"""How does time grow: with the map, the rays, the batch, the devices?

A curve is seconds over a size, median and quartiles of a few repetitions, compilation
left out. On double logarithmic axes a slope of one is "twice as much, twice as long",
the most that a map, a scan or a batch may cost; below it, something is shared.

The number of devices is fixed when a process starts, so each has a process of its own,
which makes that many out of the host's cores (`xla_force_host_platform_device_count`).
They share the cores there are: such a curve shows what dividing the work costs, not
what more machines would bring. Divided are poses to cast from, and the tiles of a map
in which a scan is looked for.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from fsmsm_jax.alignment.match import match
from fsmsm_jax.benchmark.clock import clock
from fsmsm_jax.benchmark.stages import (
    Amounts,
    Scene,
    random_poses,
    rays_from,
    simulated_scans,
)
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas
from fsmsm_jax.localisation.atlas_build import build_atlas
from fsmsm_jax.localisation.search import localise, localise_batch
from fsmsm_jax.sensing.lidar import Lidar
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.buildings import office

__all__ = ["CURVES", "Curve", "report_devices"]

_SIDES = ((20.0, 12.5), (40.0, 25.0), (160.0, 100.0))  # [m]
_RAYS = (90, 360, 1440)
_DEVICES = (1, 2, 4, 8)
_FINE = AtlasConfig(spacing=0.4, reach=8.0)  # six tiles of the largest floor, not one
_POSES = 1024  # of a ray cast
_PATIENCE = 300  # [s] with a process of many devices
_REPEATS = 5  # of a time on a curve


class Curve(NamedTuple):
    """Time over a size."""

    picture: str
    """Which picture it belongs to: a key of `CURVES`."""
    label: str
    size: str
    """What the sizes are, with their unit."""
    sizes: list[float]
    seconds: list[tuple[float, float, float]]
    """Lower quartile, median, upper quartile, for each size."""


def _quartiles(work: Callable[[], object], share: float = 1.0):
    """Of the seconds of one of so many parts of the work."""
    took = clock(work, _REPEATS)
    return took.low * share, took.median * share, took.high * share


def area(scene: Scene) -> Iterator[Curve]:
    """Offices from 200 to 13 000 m²: the atlas, and one query of it."""
    del scene
    sizes, builds, queries = [], [], []
    for sides in _SIDES:
        world = office(0, *sides)
        atlas = build_atlas(world)
        scans, _ = simulated_scans(world, 1)
        scan = jax.tree.map(lambda a: a[0], scans)
        sizes.append(float(world.free.sum() * world.resolution**2))
        builds.append(_quartiles(lambda w=world: build_atlas(w)))
        queries.append(_quartiles(lambda a=atlas, s=scan: localise(a, s)))
    yield Curve("area", "build_atlas", "free area [m²]", sizes, builds)
    yield Curve("area", "localise", "free area [m²]", sizes, queries)


def rays(scene: Scene) -> Iterator[Curve]:
    """Scans of 90 to 1440 rays: cast, and matched."""
    casts, matches = [], []
    for count in _RAYS:
        casts.append(_quartiles(rays_from(scene.world, _POSES, count), 1 / _POSES))
        lidar = Lidar.create(rays=count, noise=0.02)
        pose = random_poses(scene.world, 1, clearance=0.5)[0]
        exact = raycast(scene.world, pose, lidar.bearings, lidar.range_max)
        scan = lidar.measure(jax.random.key(0), exact)
        start = np.asarray(pose) + np.array([0.1, -0.1, 0.2])
        matches.append(
            _quartiles(
                lambda s=scan, p=start, n=count: match(scene.world, s, p, rays=n)
            )
        )
    sizes = [float(count) for count in _RAYS]
    label = f"raycast, a scan of {_POSES}"
    yield Curve("rays", label, "rays", sizes, casts)
    yield Curve("rays", "match, one scan", "rays", sizes, matches)


def batch(scene: Scene) -> Iterator[Curve]:
    """Scans localised together, and one by itself: time for each."""
    counts = (1, scene.amounts.scans, 4 * scene.amounts.scans)
    one, _ = scene.scan
    times = [_quartiles(lambda: localise(scene.atlas, one))]
    for count in counts[1:]:
        scans, _ = simulated_scans(scene.world, count)
        work = lambda s=scans: localise_batch(scene.atlas, s)
        times.append(_quartiles(work, 1 / count))
    sizes = [float(count) for count in counts]
    yield Curve(
        "batch", "localise, localise_batch: a scan", "scans in a batch", sizes, times
    )


def devices(scene: Scene) -> Iterator[Curve]:
    """One to eight devices made of the same cores."""
    del scene
    times: dict[str, list] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "atlas.npz")
        build_atlas(office(0, *_SIDES[-1]), _FINE).save(path)
        for count in _DEVICES:
            for label, quartiles in _asked_of(count, path).items():
                times.setdefault(label, []).append(tuple(quartiles))
    sizes = [float(count) for count in _DEVICES]
    for label, quartiles in times.items():
        yield Curve("devices", label, "devices on one host", sizes, quartiles)


def _asked_of(count: int, atlas: Path) -> dict[str, list[float]]:
    """What `report_devices` tells in a process of so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} "
    flags += f"--xla_force_host_platform_device_count={count}"
    environment = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    code = "import sys; from fsmsm_jax.benchmark.scaling import report_devices; "
    code += "report_devices(sys.argv[1])"
    try:
        answer = subprocess.run(
            [sys.executable, "-c", code, str(atlas)],
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=_PATIENCE,
        ).stdout
    except subprocess.SubprocessError as error:
        raise ChildProcessError(
            f"no times from a process with {count} host devices ({error})"
        ) from error
    return json.loads(answer.splitlines()[-1])


def report_devices(path: str | Path) -> None:
    """Print as JSON what work divided among all devices of this process takes.

    Args:
        path: of the atlas to spread; by itself if there is one device only.
    """
    scene = Scene(Amounts.of_device())
    mesh = Mesh(np.array(jax.devices()), ("poses",))
    floor = office(0, *_SIDES[-1])
    atlas = ScanAtlas.load(path, floor, mesh if mesh.size > 1 else None)
    scan = jax.tree.map(lambda a: a[0], simulated_scans(floor, 1)[0])
    everywhere, divided = PartitionSpec(), PartitionSpec("poses")
    poses = random_poses(scene.world, _POSES)
    poses = jax.device_put(poses, NamedSharding(mesh, divided))
    bearings = jnp.linspace(-jnp.pi, jnp.pi, 360, endpoint=False)

    # Each device marches its own rays: in one loop over all devices, every step of the
    # slowest ray would be a meeting of all.
    @jax.jit
    @partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(everywhere, divided),
        out_specs=divided,
        check_vma=False,  # a while_loop on each device apart is what is meant
    )
    def cast(world, poses):
        return jax.vmap(lambda pose: raycast(world, pose, bearings, 30.0))(poses)

    work = {
        f"raycast, {_POSES} scans": lambda: cast(scene.world, poses),
        f"localise, {len(atlas.tiles.corner)} tiles": lambda: localise(atlas, scan),
    }
    print(json.dumps({label: _quartiles(one) for label, one in work.items()}))


CURVES: dict[str, Callable[[Scene], Iterator[Curve]]] = {
    "area": area,
    "rays": rays,
    "batch": batch,
    "devices": devices,
}
