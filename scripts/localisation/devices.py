"""What spreading an atlas over devices costs, where they share the same two cores.

The number of host devices is fixed when a process starts, hence one of its own: it asks
each scan of the atlas on one device and of the same atlas over eight, in turns.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator

from localisation.sets import Options
from thesis.report import ROOT

from fsmsm_jax.benchmark import Metric

DEVICES, SCANS, ROUNDS = 8, 8, 5
_AMONG_DEVICES = """
import json, sys, time
from pathlib import Path

import jax
import numpy as np
from localisation.sets import Options, atlas_of, real_set

from fsmsm_jax.localisation import localise

folder, devices, scans, rounds = sys.argv[1], *map(int, sys.argv[2:])
cases = real_set("infinite-corridor", Options(Path(folder), scans))
alone = jax.device_put(atlas_of(cases.map), jax.devices()[0])
spread = alone.spread(jax.make_mesh((devices,), ("tiles",)))

def ask(atlas, scan):
    start = time.perf_counter()
    found = jax.block_until_ready(localise(atlas, scan))
    return time.perf_counter() - start, found

slower, same = [], []
for turn in range(rounds + 1):
    for scan in cases.scans:
        (one, a), (many, b) = ask(alone, scan), ask(spread, scan)
        if turn == 0:  # compiles
            places = zip(a.candidates, b.candidates, strict=True)
            same.append(all(np.array_equal(p, q) for p, q in places))
        else:
            slower.append(many / one)
ratios = np.percentile(slower, (25, 50, 75)).tolist()
print(json.dumps({"ratios": ratios, "same": 100 * np.mean(same)}))
"""


def devices(options: Options) -> Iterator[Metric]:
    """A query by eight host devices over one by one of them, and if they agree."""
    flags = f"--xla_force_host_platform_device_count={DEVICES}"
    paths = os.pathsep.join([str(ROOT), str(ROOT / "scripts")])
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": paths}
    numbers = map(str, (DEVICES, SCANS, ROUNDS))
    command = [sys.executable, "-c", _AMONG_DEVICES, str(options.recordings), *numbers]
    said = json.loads(subprocess.check_output(command, env=environment, text=True))
    low, ratio, high = said["ratios"]
    yield Metric("devices/slower", ratio, "×", "lower", 1.3, spread=(low, high))
    yield Metric("devices/same_candidates", said["same"], "%", "higher", 100)
