"""How well the mounting of a real lidar is found: a TurtleBot 4 on Olin's first floor.

The tf of the recording says [0.004 m, 0 m, 90°], from the robot's drawing. The sensor
spins clockwise and its driver lists the rays the other way round, hence sweep −1.
"""

import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table
from thesis.worlds import Options

from fsmsm_jax import Scan, load_map
from fsmsm_jax.calibration import Mounting, MountingConfig, mounting

CONFIG = MountingConfig(sweep=-1.0)
STARTS = (20.0, -20.0)  # [deg] by which the yaw is off to begin with; x and y are 0


class Outcome(NamedTuple):
    """One calibration from one start, against the recording's tf."""

    start: float
    """By how much the yaw was off to begin with [deg]."""
    yaw_error: float
    """What is found less what the tf says [deg]."""
    translation_error: float
    """Distance from what the tf says [m]."""
    found: Mounting
    """All that was found."""
    seconds: float
    """Wall-clock time, compilation included in the first."""


def measure(
    data: Path, config: MountingConfig = CONFIG, starts: Sequence[float] = STARTS
) -> Iterator[Outcome]:
    """Calibrate from each start, given the folder of recordings."""
    log = np.load(data / "real" / "mac_turtlebot4_take2.npz")
    world = load_map(data / "real" / "mac_1st_floor_9_23.yaml")
    angle = float(log["angle_min"]), float(log["angle_increment"])
    limits = float(log["range_min"]), float(log["range_max"])
    each = [Scan.from_ranges(ranges, *angle, *limits) for ranges in log["ranges"]]
    scans = jax.tree.map(lambda *a: jnp.stack(a), *each)
    first, true = log["pseudo_gt_laser_9_23"][0], log["laser_in_base"]
    for start in starts:
        begun = time.perf_counter()
        guess = [0.0, 0.0, true[2] + math.radians(start)]
        found = mounting(world, scans, log["odom_base"], first, guess, config)
        off = np.asarray(jax.block_until_ready(found.pose_base_lidar), float) - true
        yield Outcome(
            start=start,
            yaw_error=math.degrees(math.remainder(off[2], math.tau)),
            translation_error=math.hypot(off[0], off[1]),
            found=found,
            seconds=time.perf_counter() - begun,
        )


def tables(options: Options) -> Iterator[Table]:
    """What is found from each start, beside the recording's tf."""
    if options.data is None:
        return
    rows = []
    for outcome in measure(options.data, starts=STARTS[: 1 if options.quick else None]):
        x, y, yaw = np.asarray(outcome.found.pose_base_lidar, float)
        dx, dy, dyaw = np.asarray(outcome.found.std, float)
        rows.append(
            (
                f"{outcome.start:+.0f}°",
                f"{1e3 * x:.1f} ± {1e3 * dx:.1f}",
                f"{1e3 * y:.1f} ± {1e3 * dy:.1f}",
                f"{math.degrees(yaw):.2f} ± {math.degrees(dyaw):.2f}",
                f"{1e3 * outcome.translation_error:.1f}",
                f"{outcome.yaw_error:+.2f}",
                f"{outcome.seconds:.0f}",
            )
        )
        print(report(outcome), file=sys.stderr)
    head = (
        *("yaw off by", "x [mm]", "y [mm]", "yaw [°]"),
        *("off the tf [mm]", "[°]", "seconds"),
    )
    note = "A TurtleBot 4; ± is the standard deviation. Goal: 20 mm and 0.5°."
    yield Table("Mounting of a real lidar", head, rows, note)


def report(outcome: Outcome) -> str:
    """One outcome in words."""
    x, y, yaw = np.asarray(outcome.found.pose_base_lidar, float)
    dx, dy, dyaw = np.asarray(outcome.found.std, float)
    travel, turn = np.asarray(outcome.found.scales, float)
    return (
        f"mounting, mac, yaw {outcome.start:+.0f}° off to begin with: "
        f"x {1e3 * x:.1f} ± {1e3 * dx:.1f} mm, y {1e3 * y:.1f} ± {1e3 * dy:.1f} mm, "
        f"yaw {math.degrees(yaw):.2f} ± {math.degrees(dyaw):.2f}°; "
        f"off the tf by {1e3 * outcome.translation_error:.1f} mm and "
        f"{outcome.yaw_error:+.2f}°. Along with it: delay {float(outcome.found.delay):.2f} "
        f"periods, rays {100 * float(outcome.found.stretch):+.2f} % wider, travel "
        f"{100 * travel:+.1f} %, turn {100 * turn:+.1f} %, walls "
        f"{1e3 * float(outcome.found.thickness):.0f} mm thick; residual "
        f"{1e3 * float(outcome.found.residual):.0f} mm, converged "
        f"{bool(outcome.found.converged)}, {outcome.seconds:.0f} s"
    )
