"""Cost by itself: building an atlas, batches of scans, casting rays."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from localisation.sets import Options, atlas_of, real_set, world_of
from thesis.report import ROOT

from fsmsm_jax.benchmark import Metric, rays_from, seconds
from fsmsm_jax.localisation import localise_batch

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
        work = rays_from(world, 4096, 360)
        first, times = seconds(work), [seconds(work) for _ in range(7)]
        rate = 4096 * 360 / float(np.median(times)) / 1e6
        yield Metric(f"raycast/{name}", rate, "Mrays/s", "higher", 5)
        yield Metric(f"raycast/{name}_first", first, "s", "lower")
