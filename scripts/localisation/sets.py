"""Scans whose poses are known, the maps to find them in, and the questions put."""

import functools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from fsmsm_jax.benchmark import seconds, simulated_scans
from fsmsm_jax.localisation import ScanAtlas, build_atlas, localise
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, buildings, load_map


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    data: Path | None
    limit: int | None

    @property
    def recordings(self) -> Path:
        """Where the recordings are; sections that need them run only if they exist."""
        assert self.data is not None
        return self.data


class ScanSet(NamedTuple):
    """Scans whose poses are known, and the map to find them in."""

    map: Path | None
    """The map's YAML file; None is the office."""
    scans: list[Scan]
    poses: np.ndarray


class Answers(NamedTuple):
    """What `localise` said of each scan, and how long it took to say so."""

    poses: np.ndarray
    confident: np.ndarray
    seconds: np.ndarray
    first: float
    """Seconds of the first call, compilation included."""
    candidates: np.ndarray
    """Distinct places (scans, candidates, 3), best first; NaN where there were fewer."""


@functools.cache
def world_of(path: Path | None) -> OccupancyGrid:
    return buildings.office(seed=0) if path is None else load_map(path)


@functools.cache
def atlas_of(path: Path | None) -> ScanAtlas:
    """The default atlas of a map."""
    return jax.block_until_ready(build_atlas(world_of(path)))


def ask(path: Path | None, scans: Sequence[Scan], name: str) -> Answers:
    """Localise scans on the map in a file."""
    return ask_atlas(atlas_of(path), scans, name)


def ask_atlas(atlas: ScanAtlas, scans: Sequence[Scan], name: str) -> Answers:
    """Localise scans one by one, after asking for the first once to compile."""
    first = seconds(lambda: localise(atlas, scans[0]))
    poses, confident, times, candidates = [], [], [], []
    for scan in tqdm(scans, desc=name, unit="scan", leave=False, disable=None):
        start = time.perf_counter()
        result = jax.block_until_ready(localise(atlas, scan))
        times.append(time.perf_counter() - start)
        poses.append(np.asarray(result.pose))
        confident.append(bool(result.confident))
        places, scores = map(np.asarray, result.candidates[:2])
        candidates.append(np.where(np.isfinite(scores)[:, None], places, np.nan))
    told = np.stack(poses), np.array(confident), np.array(times), first
    return Answers(*told, np.stack(candidates))


def office_set(count: int) -> ScanSet:
    """270° scans with 2 cm of noise, 30 % of the rays blocked, from free places."""
    scans, poses = simulated_scans(world_of(None), count, outliers=0.3)
    return ScanSet(None, unstacked(scans), np.asarray(poses))


def unstacked(scans: Scan) -> list[Scan]:
    """Scans with a leading axis, one by one."""
    count = len(scans.ranges)
    return [jax.tree.map(lambda a, n=n: a[n], scans) for n in range(count)]


def real_set(name: str, options: Options) -> ScanSet:
    """The test scans of an honest split, and where they were taken."""
    folder = options.recordings / "real"
    if name.startswith("mac_"):
        log = dict(np.load(folder / "mac_turtlebot4_take2.npz"))
        which = np.arange(len(log["ranges"]))
        poses = log[f"pseudo_gt_laser_{name.removeprefix('mac_')}"]
        limits = float(log["range_min"]), float(log["range_max"])
        map_name = name.replace("mac_", "mac_1st_floor_")
    elif name == "infinite-corridor":
        log = dict(np.load(folder / f"{name}.npz"))
        which = np.flatnonzero(~log["in_map"])
        poses, limits = log["poses"], (0.0, float(log["range_no_return"]))
        map_name = name
    else:
        log = dict(np.load(folder / f"{name.removesuffix('_first60')}.npz"))
        which = np.load(folder / f"{name}_split.npz")["test_index"]
        poses, limits = log["poses"], (0.0, float(log["range_no_return"]))
        map_name = name
    which = which[: options.limit]
    angles = float(log["angle_min"]), float(log["angle_increment"])
    scans = [Scan.from_ranges(log["ranges"][i], *angles, *limits) for i in which]
    return ScanSet(folder / f"{map_name}.yaml", scans, poses[which])


def simulated_set(name: str, options: Options) -> tuple[ScanSet, np.ndarray]:
    """Noisy scans (σ = 0.05 m) in a big map, and their exact ranges."""
    folder = options.recordings / "gl"
    cases = {
        key: value if value.ndim == 0 else value[: options.limit]
        for key, value in np.load(folder / f"{name}_cases.npz").items()
    }
    limits = 0.0, float(cases["range_max"])
    angles = float(cases["angle_min"]), float(cases["angle_increment"])
    scans = [Scan.from_ranges(r, *angles, *limits) for r in cases["ranges_sigma0p05"]]
    poses = cases["true_pose"]
    return ScanSet(folder / f"{name}.yaml", scans, poses), cases["ranges_exact"]
