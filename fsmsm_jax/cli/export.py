"""`fsmsm export`: a tracker or a query in one file that starts without tracing."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from fsmsm_jax.cli.console import summary, timed
from fsmsm_jax.cli.localise import load_or_build_atlas
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.io.programs import platform_here
from fsmsm_jax.io.stored import load_query, load_tracker, save_query, save_tracker
from fsmsm_jax.world.ros_map import load_map


def export(
    map: Annotated[Path, tyro.conf.Positional],
    log: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    *,
    what: Literal["tracker", "query"] = "tracker",
    index: int = 0,
    topic: str | None = None,
    platform: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = (),
    spacing: float = 0.8,
    atlas: Path | None = None,
) -> None:
    """Write a tracker, or a query, with its map, for a robot to load and run.

    `fsmsm_jax.io.stored.load_tracker` and `load_query` read the file. Its first step is
    taken here, which leaves the compiled program in this machine's cache.

    Args:
        map: map_server map, a YAML file beside its image.
        log: of the robot's lidar; the file serves scans of this many rays.
        out: the file to write.
        what: a tracker follows the lidar; a query finds it on the whole map.
        index: which scan of the log, from 0; negative counts from the end.
        topic: which LaserScan topic of a rosbag that has several.
        platform: where it is to run; this machine's kind if left out.
        spacing: distance between the positions of a query's atlas in metres.
        atlas: file that keeps the atlas: loaded if it is there, else built and saved.
    """
    world = load_map(map)
    scan = read_scans(log, topic).scan(index)
    platforms = platform or None
    if what == "tracker":
        _, traced = timed(lambda: save_tracker(out, world, scan, platforms=platforms))
    else:
        scan_atlas = load_or_build_atlas(world, spacing, atlas)
        _, traced = timed(
            lambda: save_query(out, scan_atlas, scan, platforms=platforms)
        )
    print(f"{what:9} {out}, {out.stat().st_size / 1e6:.1f} MB, for {summary(scan)}")
    print(f"traced    in {traced:.2f} s", flush=True)
    if platform and platform_here() not in platform:
        return
    if what == "tracker":
        robot, loaded = timed(lambda: load_tracker(out))
        run = lambda: robot.step(robot.init(np.zeros(3)), scan)
    else:
        query, loaded = timed(lambda: load_query(out))
        run = lambda: query(scan)
    (_, first), (_, second) = timed(run), timed(run)
    print(
        f"loaded    in {loaded:.2f} s, first run {1e3 * first:.0f} ms, "
        f"then {1e3 * second:.0f} ms"
    )
