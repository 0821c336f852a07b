"""How long until the first answer? Cold and warm starts of the command line and a tracker.

    python scripts/startup.py                    # everything, some minutes
    python scripts/startup.py --only tracker
    python scripts/startup.py --quick            # one warm run of each

In order:

- `localise`: `fsmsm localise` from the shell, interpreter and imports included: with
  nothing kept (no compiled programs, no atlas), then with both;
- `tracker`: one that `fsmsm export` wrote, in a fresh process: load, first step, second.

On the map and log `real/intel` of ../shared/data, or where FSMSM_DATA points; without
them on a made-up office. Each run is a process of its own, with caches of its own; CPU
time is user and system together, which other work on the machine disturbs less.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import ROOT, Table, find_folder, number, parser_of, print_sections

from fsmsm_jax.sensing import Lidar, raycast
from fsmsm_jax.world import buildings, save_map

COMMAND = "from fsmsm_jax.cli import run; run()"
LOADED = """
import json, sys, time
from fsmsm_jax.cli.console import keep_compiled_programs
import jax
import numpy as np
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.io.stored import load_tracker

keep_compiled_programs()
scan = jax.block_until_ready(read_scans(sys.argv[2]).scan(int(sys.argv[3])))
times = [time.perf_counter()]
robot = load_tracker(sys.argv[1])
times.append(time.perf_counter())
state = robot.init(np.zeros(3))
for _ in range(2):
    state, _ = jax.block_until_ready(robot.step(state, scan))
    times.append(time.perf_counter())
print(json.dumps(np.diff(times).tolist()))
"""
_INDEX = "100"  # of the scan: one that is found


class Options(NamedTuple):
    """What the sections need to know of the command line."""

    files: tuple[str, str]  # map and log
    folder: Path  # for caches, atlas and pictures
    runs: int


class Cost(NamedTuple):
    """Of one process."""

    wall: float  # [s]
    cpu: float  # [s]
    said: str


def main() -> None:
    """Read the command line and print what it asks for."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="which tables")
    parser.add_argument("--quick", action="store_true", help="one warm run of each")
    parser.add_argument("--markdown", type=Path, help="file for the tables")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        options = Options(_files(Path(folder)), Path(folder), 1 if args.quick else 7)
        print_sections(SECTIONS, args.only, options, args.markdown)


def _files(folder: Path) -> tuple[str, str]:
    data = find_folder("FSMSM_DATA", "data")
    if data and (data / "real" / "intel.yaml").exists():
        return str(data / "real" / "intel.yaml"), str(data / "real" / "intel.npz")
    world, lidar = buildings.office(0), Lidar.create(180, noise=0.02)
    ranges = raycast(world, jnp.array([7.5, 4.0, 0.8]), lidar.bearings)
    scan = lidar.measure(jax.random.key(0), ranges)
    save_map(world, folder / "map.yaml")
    log = {"ranges": np.tile(scan.ranges, (int(_INDEX) + 1, 1)), "range_max": 30.0}
    np.savez(folder / "log.npz", bearings=np.asarray(lidar.bearings), **log)
    return str(folder / "map.yaml"), str(folder / "log.npz")


def localise(options: Options) -> Iterator[Table]:
    """The command, as a person types it, and as a program calls it."""
    atlas = ["--atlas", str(options.folder / "atlas.npz"), "--index", _INDEX]
    command = [COMMAND, "localise", *options.files, *atlas]
    drawn = [*command, "--picture", str(options.folder / "localise.png")]
    answered = [*command, "--json", "--picture", "none"]
    cold = _python(drawn, options.folder / "localise")
    warm = lambda what: _costs(what, options.folder / "localise", options.runs)
    rows = [
        _row("import jax, nothing else", warm(["import jax"])),
        _row("fsmsm localise, nothing kept, with picture", [cold]),
        _row("fsmsm localise, warm, with picture", warm(drawn)),
        _row("fsmsm localise --json --picture none, warm", warm(answered)),
    ]
    yield Table(
        f"fsmsm localise {Path(options.files[0]).stem}, from the shell",
        ("what", "wall [s]", "fastest", "CPU [s]", "runs"),
        rows,
        "Medians. Warm: compiled programs and traces in the cache, the atlas in a file.",
    )


def tracker(options: Options) -> Iterator[Table]:
    """A file that `fsmsm export` wrote, on a machine that has never seen it and after."""
    file = options.folder / "robot.fsmsm"
    export = [COMMAND, "export", *options.files, str(file), "--index", _INDEX]
    _python(export, options.folder / "exporter")
    loading = [LOADED, str(file), options.files[1], _INDEX]
    cold = _python(loading, options.folder / "tracker")
    warm = _costs(loading, options.folder / "tracker", options.runs)
    rows = []
    for what, costs in (("nothing kept", [cold]), ("compiled before", warm)):
        load, *steps = np.median([json.loads(cost.said) for cost in costs], axis=0)
        steps = [number(1e3 * step) for step in steps]
        rows.append((what, number(load), *steps, str(len(costs))))
    yield Table(
        f"an exported tracker on {Path(options.files[0]).stem}, "
        f"{file.stat().st_size / 1e6:.1f} MB",
        ("on a machine with", "load [s]", "first step [ms]", "second [ms]", "runs"),
        rows,
        "Medians. Load: file, map and machine code; first step: with `init`.",
    )


SECTIONS = {"localise": localise, "tracker": tracker}


def _python(words: list[str], cache: Path) -> Cost:
    """One process of this interpreter, its caches in a folder of their own."""
    ours = {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)}
    theirs = ("FSMSM_NO_CACHE", "JAX_COMPILATION_CACHE_DIR")
    environment = {k: v for k, v in os.environ.items() if k not in theirs} | ours
    before, start = _children(), time.perf_counter()
    run = subprocess.run(
        [sys.executable, "-c", *words], env=environment, capture_output=True, text=True
    )
    wall = time.perf_counter() - start
    if run.returncode:
        raise RuntimeError(run.stderr)
    return Cost(wall, _children() - before, run.stdout)


def _costs(words: list[str], cache: Path, runs: int) -> list[Cost]:
    return [_python(words, cache) for _ in range(runs)]


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _row(what: str, costs: list[Cost]) -> tuple[str, ...]:
    wall, cpu = [cost.wall for cost in costs], [cost.cpu for cost in costs]
    found = [float(np.median(wall)), min(wall), float(np.median(cpu))]
    return (what, *map(number, found), str(len(costs)))


if __name__ == "__main__":
    main()
