"""How good is it? Prints the goals of this project beside what is measured here.

    python scripts/bench_localisation.py                    # everything, some 10 min
    python scripts/bench_localisation.py --only mac_final   # the rows mac_final/...
    python scripts/bench_localisation.py --quick --gate     # CI: no worse than before

The part of a key before the slash is what `--only` takes, so each row says how to
measure it again. Recordings are looked for at ../shared/data, or where FSMSM_DATA
points; without them only the made-up office is measured. In order:

- `office`: scans simulated in a procedural building, a third of the rays blocked;
- real honest splits: the map knows nothing of the visit that is localised;
- simulated scans in big maps, beside the Cramér–Rao bound and CBGL's results;
- `off_map`: scans of one building on the map of another, never to be believed;
- `atlas` (each in a process of its own), `batch` and `raycast`.

Right is < 0.3 m and < 5° (simulated: < 0.5 m); sure but wrong is `confident` and not
right; errors are medians of the right answers. Times are medians after a warm-up; the
first call, compilation included, has rows of its own. Machines differ and are shared,
so the gate looks at no seconds but at ratios to a fixed reference workload that is
timed in between.
"""

import argparse
import functools
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import find_folder, parser_of
from tqdm import tqdm

from fsmsm_jax.evaluation import cramer_rao_bound, pose_errors, position_rms, success
from fsmsm_jax.localisation import ScanAtlas, build_atlas, localise, localise_batch
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid, buildings, load_map

ROOT = Path(__file__).resolve().parents[1]
BASELINE = Path(__file__).with_name("baseline_localisation.json")
QUICK_SECTIONS, QUICK_SCANS = ("office", "intel_first60"), 40


class Metric(NamedTuple):
    """One row of the table."""

    key: str
    """Section and quantity, `section/quantity`."""
    value: float
    unit: str
    direction: str = "higher"
    """Which way is better: "higher" or "lower"."""
    goal: float | None = None
    """What the project wants; None where a row only informs."""
    rel_tol: float | None = None
    """Share of the baseline by which it may get worse; None is not gated."""

    @property
    def met(self) -> bool | None:
        """Whether the goal is met."""
        return None if self.goal is None else self.reaches(self.goal)

    def reaches(self, bound: float) -> bool:
        """Whether the value is on the good side of a bound, or on it. NaN is not."""
        sign = 1 if self.direction == "higher" else -1
        return sign * self.value >= sign * bound - 1e-9


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    data: Path | None
    limit: int | None

    @property
    def recordings(self) -> Path:
        """Where the recordings are; sections that need them run only if they exist."""
        assert self.data is not None
        return self.data


# What others reach, measured on a like machine or as they state it; for comparison.
PEERS = {
    "cbgl_willow/right": "CBGL 74 as published, 98 repaired, 100 improved",
    "cbgl_warehouse/right": "CBGL 82 as published, 100 repaired and improved",
    "basement_5cm/right": "CBGL 74 as published, 96 repaired, 92 improved",
    "cbgl_willow/within_5cm": "CBGL 74, 96, 100",
    "cbgl_warehouse/within_5cm": "CBGL 82, 100, 100",
    "basement_5cm/within_5cm": "CBGL 72, 90, 90",
    "cbgl_willow/position": "CBGL 6.1 repaired, 3 to 6 improved",
    "cbgl_warehouse/position": "CBGL 7.3 repaired, 3 to 6 improved",
    "basement_5cm/position": "CBGL 13.3 repaired, 3 to 6 improved",
    "cbgl_willow/query": "CBGL 3200",
    "cbgl_warehouse/query": "CBGL 1870",
    "basement_5cm/query": "CBGL 1510",
    "cbgl_willow/rays_off": "range_libc 1 to 25, plain C++ 0",
    "basement_5cm/rays_off": "range_libc 1 to 25, plain C++ 0",
    "raycast/cbgl_willow": "range_libc 2.9 to 7.9, plain C++ 4.5 (one thread)",
    "raycast/basement_5cm": "range_libc 2.1 to 11.5, plain C++ 3.6 (one thread)",
}


# --- The clock ----------------------------------------------------------------------


def seconds(work: Callable[[], object]) -> float:
    """How long the work takes until its arrays are there."""
    start = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - start


@functools.cache
def reference_workload() -> Callable[[], jax.Array]:
    """A fixed piece of work, some 20 ms of what localising is made of."""

    @jax.jit
    def work(image, matrix, index):
        image = jax.lax.fori_loop(
            0, 8, lambda _, a: jnp.fft.irfft2(jnp.fft.rfft2(a) * 0.5), image
        )
        matrix = jax.lax.fori_loop(0, 8, lambda _, a: a @ a / len(a), matrix)
        return image.sum() + matrix.sum() + image.reshape(-1)[index].sum()

    keys = jax.random.split(jax.random.key(0), 3)
    image = jax.random.normal(keys[0], (512, 512))
    matrix = jax.random.normal(keys[1], (384, 384))
    index = jax.random.randint(keys[2], (1 << 19,), 0, image.size)
    jax.block_until_ready(work(image, matrix, index))
    return lambda: work(image, matrix, index)


def ratio_to_reference(work: Callable[[], object], repeats: int = 15) -> float:
    """Time of the work in units of the reference, the two timed in turn."""
    reference = reference_workload()
    jax.block_until_ready(work())
    return float(
        np.median([seconds(work) / seconds(reference) for _ in range(repeats)])
    )


# --- Sets of scans ------------------------------------------------------------------


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


@functools.cache
def world_of(path: Path | None) -> OccupancyGrid:
    return buildings.office(seed=0) if path is None else load_map(path)


@functools.cache
def atlas_of(path: Path | None) -> ScanAtlas:
    """The default atlas of a map."""
    return jax.block_until_ready(build_atlas(world_of(path)))


def ask(path: Path | None, scans: Sequence[Scan], name: str) -> Answers:
    """Localise scans one by one, after asking for the first once to compile."""
    atlas = atlas_of(path)
    first = seconds(lambda: localise(atlas, scans[0]))
    poses, confident, times = [], [], []
    for scan in tqdm(scans, desc=name, unit="scan", leave=False, disable=None):
        start = time.perf_counter()
        result = jax.block_until_ready(localise(atlas, scan))
        times.append(time.perf_counter() - start)
        poses.append(np.asarray(result.pose))
        confident.append(bool(result.confident))
    return Answers(np.stack(poses), np.array(confident), np.array(times), first)


def office_set(count: int) -> ScanSet:
    """270° scans with 2 cm of noise, 30 % of the rays blocked, from free places."""
    poses = free_poses(world_of(None), count, clearance=0.4)
    lidar = Lidar.create(rays=360, field_of_view=1.5 * np.pi, noise=0.02, outliers=0.3)
    cast = lambda pose: raycast(world_of(None), pose, lidar.bearings, lidar.range_max)
    exact = jax.jit(jax.vmap(cast))(poses)
    keys = jax.random.split(jax.random.key(0), count)
    scans = [lidar.measure(*pair) for pair in zip(keys, exact, strict=True)]
    return ScanSet(None, scans, np.asarray(poses))


def real_set(name: str, options: Options) -> ScanSet:
    """The test scans of an honest split, and where they were taken."""
    folder = options.recordings / "real"
    if name.startswith("mac_"):
        log = dict(np.load(folder / "mac_turtlebot4_take2.npz"))
        which = np.arange(len(log["ranges"]))
        poses = log[f"pseudo_gt_laser_{name.removeprefix('mac_')}"]
        limits = float(log["range_min"]), float(log["range_max"])
        map_name = name.replace("mac_", "mac_1st_floor_")
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


def free_poses(world: OccupancyGrid, count: int, clearance: float = 0.0) -> jax.Array:
    """Random poses (count, 3) in free space, the same ones every time."""
    rng = np.random.default_rng(0)
    free = np.asarray(world.free & (world.distance > clearance))
    cells = np.argwhere(free)[rng.integers(0, free.sum(), count)][:, ::-1]
    position = world.to_map(jnp.asarray(cells + rng.uniform(0.1, 0.9, cells.shape)))
    heading = rng.uniform(-np.pi, np.pi, (count, 1))
    return jnp.concatenate([position, jnp.asarray(heading, position.dtype)], axis=1)


# --- Sections: each yields the rows of its name --------------------------------------


def office(options: Options) -> Iterator[Metric]:
    """The building that everyone has, and the clock that CI can trust."""
    cases = office_set(options.limit or 50)
    answers = ask(cases.map, cases.scans, "office")
    yield from rates("office", cases, answers)
    yield from errors("office", cases, answers, gated=True)
    yield from query_times("office", answers)
    atlas, scan = atlas_of(None), cases.scans[0]
    ratio = ratio_to_reference(lambda: localise(atlas, scan))
    yield Metric("office/query_ratio", ratio, "× reference", "lower", None, 1.5)
    cast = cast_from_everywhere(world_of(None), 1024)
    yield Metric(
        "office/raycast_ratio",
        ratio_to_reference(cast),
        "× reference",
        "lower",
        None,
        1.5,
    )


def real(
    name: str,
    options: Options,
    *,
    right: float,
    precise: bool = False,
    query: float | None = None,
) -> Iterator[Metric]:
    """An honest split: one scan, no prior; errors have goals if poses are `precise`."""
    cases = real_set(name, options)
    answers = ask(cases.map, cases.scans, name)
    yield from rates(name, cases, answers, right)
    goals = (3.0, 0.3) if precise else (None, None)
    yield from errors(name, cases, answers, *goals, gated=True)
    yield from query_times(name, answers, query)


def simulated(
    name: str, options: Options, *, right: float, query: float | None = None
) -> Iterator[Metric]:
    """Big maps, 360 rays: how near to the bound that physics sets?"""
    cases, exact = simulated_set(name, options)
    answers = ask(cases.map, cases.scans, name)
    yield from rates(name, cases, answers, right, limit=0.5)
    near = success(jnp.asarray(answers.poses), jnp.asarray(cases.poses), 0.05)
    yield Metric(f"{name}/within_5cm", percent(near), "%", "higher", right)
    yield from errors(name, cases, answers, limit=0.5, unit="mm")
    yield from efficiency(name, cases, answers)
    yield from query_times(name, answers, query)

    scan, poses = cases.scans[0], jnp.asarray(cases.poses, float)
    cast = lambda pose: raycast(
        world_of(cases.map), pose, scan.bearings, scan.range_max
    )
    ranges = jax.jit(jax.vmap(cast))(poses)
    off = np.abs(ranges - np.minimum(exact, float(scan.range_max))) > 0.1
    yield Metric(f"{name}/rays_off", percent(off), "% > 0.1 m", "lower", 0.1)


def off_map(options: Options) -> Iterator[Metric]:
    """Scans of another building: whatever comes out must not be believed."""
    splits = {name: real_set(f"{name}_first60", options) for name in ("csail", "intel")}
    for scanned, mapped in (("csail", "intel"), ("intel", "csail")):
        key = f"off_map/{scanned}_on_{mapped}"
        answers = ask(splits[mapped].map, splits[scanned].scans, key)
        yield Metric(f"{key}_confident", percent(answers.confident), "%", "lower", 0.5)


def rates(
    name: str,
    cases: ScanSet,
    answers: Answers,
    right: float | None = None,
    limit: float = 0.3,
) -> Iterator[Metric]:
    """How often right, how often sure, and how often both wrong and sure."""
    good = is_right(cases, answers, limit)
    wrong = answers.confident & ~good
    yield Metric(f"{name}/scans", len(good), "scans")
    yield Metric(f"{name}/right", percent(good), "%", "higher", right, 0.03)
    yield Metric(
        f"{name}/confident", percent(answers.confident), "%", "higher", None, 0.1
    )
    yield Metric(f"{name}/sure_but_wrong", percent(wrong), "%", "lower", 0.5, 0.0)


def errors(
    name: str,
    cases: ScanSet,
    answers: Answers,
    position_goal: float | None = None,
    orientation_goal: float | None = None,
    limit: float = 0.3,
    unit: str = "cm",
    gated: bool = False,
) -> Iterator[Metric]:
    """Median errors of the right answers."""
    good = is_right(cases, answers, limit)
    position, orientation = pose_errors(
        jnp.asarray(answers.poses[good]), jnp.asarray(cases.poses[good])
    )
    metres = {"cm": 1e2, "mm": 1e3}[unit] * median(position)
    degrees = np.rad2deg(median(orientation))
    worse = 0.3 if gated else None
    yield Metric(f"{name}/position", metres, unit, "lower", position_goal, worse)
    yield Metric(f"{name}/orientation", degrees, "°", "lower", orientation_goal, worse)


def efficiency(name: str, cases: ScanSet, answers: Answers) -> Iterator[Metric]:
    """Errors of the right answers over the Cramér–Rao bound at their places."""
    world, scan = world_of(cases.map), cases.scans[0]
    bound = lambda pose: position_rms(
        cramer_rao_bound(world, pose, scan.bearings, scan.range_max, sigma=0.05)
    )
    good = is_right(cases, answers, limit=0.5)
    truth = jnp.asarray(cases.poses[good], float)
    least = np.asarray(jax.jit(jax.vmap(bound))(truth))
    error, _ = pose_errors(jnp.asarray(answers.poses[good]), truth)
    rms = lambda a: float(np.sqrt(np.mean(np.square(a))))
    yield Metric(f"{name}/bound", 1e3 * median(least), "mm", "lower")
    yield Metric(f"{name}/error_to_bound", median(error / least), "×", "lower", 1.3)
    yield Metric(f"{name}/rmse_to_rms_bound", rms(error) / rms(least), "×", "lower")


def query_times(
    name: str, answers: Answers, goal: float | None = None
) -> Iterator[Metric]:
    """Milliseconds of one query, refinement and all, and seconds of the first."""
    low, middle, high = 1e3 * np.percentile(answers.seconds, (10, 50, 90))
    yield Metric(f"{name}/query", middle, "ms", "lower", goal)
    yield Metric(f"{name}/query_p10", low, "ms", "lower")
    yield Metric(f"{name}/query_p90", high, "ms", "lower")
    yield Metric(f"{name}/first_query", answers.first, "s", "lower")


def is_right(cases: ScanSet, answers: Answers, limit: float) -> np.ndarray:
    poses, truth = jnp.asarray(answers.poses), jnp.asarray(cases.poses, float)
    return np.asarray(success(poses, truth, limit))


def percent(flags) -> float:
    return 100 * float(np.mean(flags))


def median(values) -> float:
    """The median, NaN (which reaches no goal) of nothing."""
    return float(np.median(values)) if np.size(values) else np.nan


_IN_A_FRESH_PROCESS = """
import json, sys, time
import jax
from fsmsm_jax.localisation import AtlasConfig, ScanAtlas, build_atlas
from fsmsm_jax.world import load_map

task, map_path, atlas_path, started = sys.argv[1:]
world = load_map(map_path)
ready = time.time()
if task == "build":
    atlas = build_atlas(world, AtlasConfig(spacing=0.25))
else:
    atlas = ScanAtlas.load(atlas_path, world)
jax.block_until_ready(atlas)
done = time.time()
if task == "build":
    atlas.save(atlas_path)
size = sum(leaf.nbytes for leaf in jax.tree.leaves(atlas))
print(json.dumps({"own": done - ready, "whole": done - float(started), "size": size}))
"""


def cold_atlas(options: Options) -> Iterator[Metric]:
    """The intel map at 0.25 m in a fresh process: own work, and start-up and all.

    Memory is that of all arrays, the map's own included.
    """
    map_path = options.recordings / "real" / "intel.yaml"
    with tempfile.TemporaryDirectory() as folder:
        arguments = str(map_path), f"{folder}/atlas.npz"
        built = in_a_fresh_process("build", *arguments)
        size_on_disk = Path(folder, "atlas.npz").stat().st_size
        loaded = in_a_fresh_process("load", *arguments)
    yield Metric("atlas/build_process", built["whole"], "s", "lower", 15)
    yield Metric("atlas/build", built["own"], "s", "lower")
    yield Metric("atlas/memory", built["size"] / 1e6, "MB", "lower", 200)
    yield Metric("atlas/file", size_on_disk / 1e6, "MB", "lower")
    yield Metric("atlas/load", loaded["own"], "s", "lower", 1)
    yield Metric("atlas/load_process", loaded["whole"], "s", "lower")


def in_a_fresh_process(*arguments: str) -> dict[str, float]:
    """Run the script above with an empty compilation cache."""
    environment = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    command = [sys.executable, "-c", _IN_A_FRESH_PROCESS, *arguments, str(time.time())]
    output = subprocess.check_output(command, env=environment, cwd=ROOT, text=True)
    return json.loads(output)


def batch(options: Options) -> Iterator[Metric]:
    """64 intel scans in one call."""
    cases = real_set("intel_first60", options._replace(limit=64))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases.scans)
    atlas = atlas_of(cases.map)
    work = lambda: localise_batch(atlas, stacked)
    first, times = seconds(work), [seconds(work) for _ in range(3)]
    rate = len(cases.scans) / float(np.median(times))
    yield Metric("batch/intel_first60", rate, "scans/s", "higher", 40)
    yield Metric("batch/intel_first60_first", first, "s", "lower")


def raycast_throughput(options: Options) -> Iterator[Metric]:
    """4096 random free poses × 360 rays, 30 m."""
    for folder, name in (
        ("gl", "cbgl_willow"),
        ("real", "intel"),
        ("gl", "basement_5cm"),
    ):
        world = world_of(options.recordings / folder / f"{name}.yaml")
        work = cast_from_everywhere(world, 4096)
        first, times = seconds(work), [seconds(work) for _ in range(7)]
        rate = 4096 * 360 / float(np.median(times)) / 1e6
        yield Metric(f"raycast/{name}", rate, "Mrays/s", "higher", 5)
        yield Metric(f"raycast/{name}_first", first, "s", "lower")


def cast_from_everywhere(world: OccupancyGrid, count: int) -> Callable[[], jax.Array]:
    poses = free_poses(world, count)
    bearings = jnp.linspace(-jnp.pi, jnp.pi, 360, endpoint=False)
    cast = jax.jit(jax.vmap(raycast, in_axes=(None, 0, None, None)))
    return lambda: cast(world, poses, bearings, 30.0)


partial = functools.partial
SECTIONS: dict[str, Callable[[Options], Iterator[Metric]]] = {
    "office": office,
    "mac_9_23": partial(real, "mac_9_23", right=99, precise=True),
    "mac_final": partial(real, "mac_final", right=99, precise=True),
    "intel_first60": partial(real, "intel_first60", right=99, precise=True, query=60),
    "freiburg-079_first60": partial(real, "freiburg-079_first60", right=92),
    "csail_first60": partial(real, "csail_first60", right=95),
    "cbgl_willow": partial(simulated, "cbgl_willow", right=100, query=120),
    "cbgl_warehouse": partial(simulated, "cbgl_warehouse", right=100),
    "basement_5cm": partial(simulated, "basement_5cm", right=98),
    "off_map": off_map,
    "atlas": cold_atlas,
    "batch": batch,
    "raycast": raycast_throughput,
}


# --- The table ----------------------------------------------------------------------


def cells(row: Metric) -> tuple[str, str, str, str, str]:
    """Key, value with unit, goal, verdict and peers of a row, as text."""
    sign = "≥" if row.direction == "higher" else "≤"
    goal = "" if row.goal is None else f"{sign} {row.goal:g}"
    verdict = {None: "", True: "met", False: "MISSED"}[row.met]
    whole = isinstance(row.value, int) or abs(row.value) >= 100
    digits = 0 if whole else 1 if abs(row.value) >= 10 else 2
    value = f"{row.value:.{digits}f} {row.unit}"
    return row.key, value, goal, verdict, PEERS.get(row.key, "")


def line(row: Metric) -> str:
    key, value, goal, verdict, peers = cells(row)
    return f"{key:38} {value:>17} {goal:>7} {verdict:6}  {peers}".rstrip()


def markdown(rows: Sequence[Metric]) -> str:
    """The rows that have a goal or a peer, for the README."""
    rows = [row for row in rows if row.goal is not None or row.key in PEERS]
    head = "| measured | value | goal | | others |\n|---|---|---|---|---|"
    return "\n".join([head, *(f"| {' | '.join(cells(row))} |" for row in rows)])


def circumstances() -> dict[str, str]:
    """Where, with what and of which commit this was measured."""
    describe = ["git", "describe", "--always", "--dirty"]
    git = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True)
    return {
        "command": " ".join(["python", *sys.argv]),
        "commit": git.stdout.strip() or "unknown",
        "device": f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores",
        "jax": jax.__version__,
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }


def write(path: Path, rows: Sequence[Metric]) -> None:
    record = circumstances() | {"metrics": [row._asdict() for row in rows]}
    path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


def regressions(rows: Sequence[Metric], baseline: Sequence[Metric]) -> list[str]:
    """What got worse than the baseline by more than its tolerance, or is gone.

    Rows of sections that did not run at all (no recordings here) are not compared.
    """
    now = {row.key: row for row in rows}
    ran = {row.key.split("/")[0] for row in rows}
    worse = []
    for old in baseline:
        new = now.get(old.key)
        if new is None:
            if old.key.split("/")[0] in ran:
                worse.append(f"{old.key} is in the baseline but was not measured")
        elif new.rel_tol is not None:
            slack = new.rel_tol if new.direction == "lower" else -new.rel_tol
            allowed = old.value * (1 + slack)
            if not new.reaches(allowed):
                worse.append(
                    f"{new.key} is {new.value:.4g} {new.unit}, was {old.value:.4g}; "
                    f"{allowed:.4g} would do"
                )
    return worse


# --- The command line ---------------------------------------------------------------


def main() -> int:
    arguments = parse()
    data = find_folder("FSMSM_DATA", "data")
    names = arguments.only or (QUICK_SECTIONS if arguments.quick else tuple(SECTIONS))
    if data is None:
        left_out = [name for name in names if name != "office"]
        names = [name for name in names if name == "office"]
        print(f"no recordings, so without: {', '.join(left_out)}", file=sys.stderr)
    if not arguments.quick:  # the rows of first calls are about compiling
        jax.config.update("jax_enable_compilation_cache", False)

    limit = arguments.limit or (QUICK_SCANS if arguments.quick else None)
    print("\n".join(f"{k:9} {v}" for k, v in circumstances().items()), "\n", flush=True)
    rows = []
    for name in names:
        for row in SECTIONS[name](Options(data, limit)):
            rows.append(row)
            print(line(row), flush=True)
    goals = [row.met for row in rows if row.goal is not None]
    print(f"\n{sum(map(bool, goals))} of {len(goals)} goals met")

    if arguments.markdown:
        print(f"\n{markdown(rows)}")
    if arguments.json:
        write(arguments.json, rows)
    if arguments.write_baseline:
        write(BASELINE, rows)
    return gate(rows) if arguments.gate else 0


def gate(rows: Sequence[Metric]) -> int:
    """Say what got worse; the exit status."""
    saved = json.loads(BASELINE.read_text())["metrics"]
    worse = regressions(rows, [Metric(**row) for row in saved])
    print("\n".join(f"REGRESSION {text}" for text in worse) or "no regressions")
    return 1 if worse else 0


def parse() -> argparse.Namespace:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--quick", action="store_true", help="office and 40 intel scans: minutes")
    add("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="these sections")
    add("--limit", type=int, metavar="N", help="only the first N scans of each set")
    add("--json", type=Path, metavar="FILE", help="write all rows there")
    add("--markdown", action="store_true", help="print the table for the README")
    either = parser.add_mutually_exclusive_group().add_argument
    either("--gate", action="store_true", help="exit 1 if worse than the baseline")
    either("--write-baseline", action="store_true", help=f"write {BASELINE.name}")
    arguments = parser.parse_args()
    if arguments.limit is not None and arguments.limit < 1:
        parser.error("--limit must be 1 or more")
    baseline = arguments.gate or arguments.write_baseline
    if baseline and (not arguments.quick or arguments.only or arguments.limit):
        parser.error("the baseline is that of --quick, without --only and --limit")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
