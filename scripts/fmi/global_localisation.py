"""PGL-FMIC in the thesis's worlds, and the same scans through `localise`."""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from fmi.published import ENVIRONMENTS, NOISES, Published
from scipy import ndimage
from thesis.report import Table, number, percent

import fsmsm_jax as fj
from fsmsm_jax.alignment.fmi_spomf import FmiConfig
from fsmsm_jax.evaluation import share_of
from fsmsm_jax.localisation.pgl_fmic import PUBLISHED, PglFmicConfig, pgl_fmic
from fsmsm_jax.world import OccupancyGrid

RANGE_MAX, RAYS = 10.0, 720
VALID = 1.0  # [m]
CLEARANCE = 0.3  # [m] from a pose to the nearest wall
WIDEST_DOOR = 2.2  # [m]: a gap narrower than this in the outer wall does not let out
CORRIDOR_POSES = ((11.56, 12.20, 0.0), (4.56, 10.20, 0.0))  # x_a and x_b of §4

HEAD = (
    *("world", "method", "σ [m]", "scans", "valid % [95 %]", "published"),
    *("mean error [m]", "published", "[rad]", "published"),
    *("ms a hypothesis", "published", "ms a scan", "trusted, of these valid"),
)


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    runs: int = 4
    quick: bool = False
    data: Path | None = None


class Answer(NamedTuple):
    """Of one scan."""

    pose: np.ndarray
    trusted: bool
    seconds: float


def tables(options: Options) -> Iterator[Table]:
    """Valid solutions, errors and times, world by world."""
    for name, world, published, config in _worlds(options):
        yield _table(name, world, published, config, options)


def _worlds(options: Options) -> Iterator[tuple]:
    maps = options.data / "maps" if options.data else None
    found = {
        name: path
        for name in ENVIRONMENTS
        if maps and (path := maps / f"phd_li9i_csv__{name}.yaml").is_file()
    }
    if options.quick or not found:
        print("... a generated office in place of the thesis's maps", file=sys.stderr)
        office = fj.buildings.office(seed=0, width=10.0, height=8.0)
        none = (np.nan, np.nan, np.nan)
        nothing = Published(3, 40, none, none, none, "")
        small = PglFmicConfig(size=64, rays=180, registration=_of_size(64), finalists=8)
        config = small if options.quick else PglFmicConfig()
        yield "generated office", office, nothing, config
        return
    for name, path in found.items():
        world = indoors(fj.load_map(path))
        yield name.upper(), world, ENVIRONMENTS[name], PglFmicConfig()


def _of_size(size: int) -> FmiConfig:
    return FmiConfig(size, size // 2, candidates=1, kept=1, largest_scale=1.2)


def indoors(world: OccupancyGrid) -> OccupancyGrid:
    """The map with what lies outside its outer walls unknown, doors taken as shut."""
    occupied, cell = np.asarray(world.occupied), float(world.resolution)
    width = int(np.ceil(WIDEST_DOOR / cell))
    wall = np.pad(occupied, width + 2)
    to_wall = np.asarray(ndimage.distance_transform_edt(~wall)) * cell
    part = np.zeros(wall.shape, np.int32)
    ndimage.label(to_wall > WIDEST_DOOR / 2, output=part)
    outside = part == part[0, 0]
    grown = np.asarray(ndimage.distance_transform_edt(~outside)) * cell
    within = (grown > WIDEST_DOOR / 2 + cell)[
        width + 2 : -width - 2, width + 2 : -width - 2
    ]
    cells = np.where(occupied, 100, np.where(within, 0, -1))
    return OccupancyGrid.from_cells(cells, cell, np.asarray(world.origin))


def draw_poses(world: OccupancyGrid, count: int, seed: int) -> np.ndarray:
    """Poses in the largest space that a robot can drive about in, in any direction."""
    room = (np.asarray(world.distance) > CLEARANCE) & np.asarray(world.free)
    part = np.zeros(room.shape, np.int32)
    ndimage.label(room, output=part)
    largest = 1 + np.argmax(np.bincount(part.ravel())[1:])
    rng = np.random.default_rng(seed)
    cells = np.argwhere(part == largest)[:, ::-1]
    chosen = cells[rng.integers(0, len(cells), count)] + rng.uniform(0, 1, (count, 2))
    xy = np.asarray(world.to_map(jnp.asarray(chosen, float)))
    return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])


def _table(name, world, published, config, options) -> Table:
    count = published.poses * options.runs
    poses = draw_poses(world, count, seed=0)
    if name == "CORRIDOR":
        poses[:2] = CORRIDOR_POSES
    start = time.perf_counter()
    atlas = fj.build_atlas(world)
    building = time.perf_counter() - start
    by_pictures = lambda config: (
        lambda key, scan: _pictured(key, world, scan, published.hypotheses, config)
    )
    methods: dict[str, Callable] = {"PGL-FMIC": by_pictures(config)}
    if not options.quick:
        methods["as the thesis"] = by_pictures(PUBLISHED)
    methods["localise"] = lambda key, scan: _looked_up(atlas, scan)
    rows = []
    for k, noise in enumerate(NOISES[:1] if options.quick else NOISES):
        scans = _scans(world, poses, noise)
        for method, answer in methods.items():
            answer(jax.random.key(0), scans[0])  # compile
            keys = jax.random.split(jax.random.key(k), count)
            found = [answer(*ask) for ask in zip(keys, scans, strict=True)]
            rows.append(_row(name, method, k, found, poses, published))
            print("... " + "  ".join(rows[-1]), file=sys.stderr, flush=True)
    free = np.asarray(world.free).sum() * float(world.resolution) ** 2
    note = (
        f"{count} poses drawn in {free:.0f} m² ({published.poses} published), one scan "
        f"each a σ: {RAYS} rays, 360°, {RANGE_MAX} m; |H| = {published.hypotheses}; "
        f"valid: less than {VALID} m off. As the thesis: centroids, one round, N_G = 256, "
        f"but one scale for both pictures. Atlas of localise: {building:.1f} s, once."
    )
    return Table(f"{name}: passive global localisation", HEAD, rows, note)


def _scans(world, poses, noise) -> list[fj.Scan]:
    lidar = fj.Lidar.create(RAYS, range_max=RANGE_MAX, noise=noise)

    @jax.jit
    def measure(world, key, pose):
        return lidar.measure(key, fj.raycast(world, pose, lidar.bearings, RANGE_MAX))

    keys = jax.random.split(jax.random.key(7), len(poses))
    some = jnp.asarray(poses, float)
    return [measure(world, *ask) for ask in zip(keys, some, strict=True)]


def _pictured(key, world, scan, hypotheses, config) -> Answer:
    start = time.perf_counter()
    found = jax.block_until_ready(pgl_fmic(key, world, scan, hypotheses, config))
    seconds = time.perf_counter() - start
    return Answer(np.asarray(found.pose), bool(found.converged), seconds)


def _looked_up(atlas, scan) -> Answer:
    start = time.perf_counter()
    found = jax.block_until_ready(fj.localise(atlas, scan))
    seconds = time.perf_counter() - start
    return Answer(np.asarray(found.pose), bool(found.confident), seconds)


def _row(name, method, k, found: list[Answer], poses, published):
    off = np.array([answer.pose for answer in found], float) - poses
    metres = np.hypot(off[:, 0], off[:, 1])
    radians = np.abs(np.remainder(off[:, 2] + np.pi, 2 * np.pi) - np.pi)
    valid = metres < VALID
    trusted = np.array([answer.trusted for answer in found])
    each = 1e3 * np.median([answer.seconds for answer in found])
    pictured = method != "localise"
    mean = lambda errors: number(errors[valid].mean()) if valid.any() else ""
    there = lambda text: text if pictured and "nan" not in text else ""
    right = f"{np.sum(valid & trusted)} of {trusted.sum()}" if trusted.any() else ""
    return (
        *(name, method, str(NOISES[k]), str(len(found)), percent(share_of(valid))),
        there(f"{100 - published.invalid[k]:.1f}"),
        *(mean(metres), there(f"{published.metres[k]}")),
        *(mean(radians), there(f"{published.radians[k]}")),
        number(each / published.hypotheses) if pictured else "",
        there(published.milliseconds),
        *(number(each), right),
    )
