"""`fsmsm track`: where was the robot, from the first scan of a log to the last?"""

import sys
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from fsmsm_jax.cli.console import area, pose_in_words, save_picture
from fsmsm_jax.cli.localise import load_or_build_atlas
from fsmsm_jax.cli.runs import (
    Run,
    circumstances,
    new_folder,
    picture_path,
    scan_times,
    write_json,
)
from fsmsm_jax.io.logs import ScanLog, read_scans
from fsmsm_jax.localisation.follow import FollowConfig, follow
from fsmsm_jax.localisation.track import stacked
from fsmsm_jax.sensing.sweep import moments
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.ros_map import load_map

_IN_A_WALL = 0.3  # [m] from free space an initial pose makes no sense


def track(
    map: Annotated[Path, tyro.conf.Positional],
    log: Annotated[Path, tyro.conf.Positional],
    *,
    initial: Annotated[
        tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y DEGREES")
    ] = None,
    anywhere: Annotated[bool, tyro.conf.arg(name="global")] = False,
    tum: Path | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    topic: str | None = None,
    odometry_topic: str | None = None,
    no_odometry: bool = False,
    sweep: Literal["none", "stated", "reversed"] = "none",
    json: bool = False,
    spacing: float = 0.8,
    atlas: Path | None = None,
) -> None:
    """Say where on a map the lidar was, scan by scan, through a whole log.

    It is found, followed, and found again if somebody carried it away. Ctrl-C ends a
    run early; what was computed is kept.

    Args:
        map: map_server map, a YAML file beside its image.
        log: rosbag, CARMEN log or .npz with ranges, angle_min and angle_increment.
        initial: about where the lidar was at the first scan, in metres and degrees.
        anywhere: it may have been anywhere on the map; so it is without --initial.
        tum: where to write the trajectory, without poses at which the lidar was lost.
        plot: where to write the picture, none for no picture; else track.png.
        out: new folder for trajectory, fixes, metrics, picture and all settings.
        topic: which LaserScan topic of a rosbag that has several.
        odometry_topic: which Odometry topic of a rosbag that has several.
        no_odometry: leave the log's odometry alone.
        sweep: undo the motion during each scan by the times of its rays; drivers lie
            about their order, so try both and keep what the map explains better.
        json: print one JSON object instead of text.
        spacing: distance between the positions of the atlas in metres.
        atlas: file that keeps the atlas: loaded if it is there, else built and saved.

    Raises:
        ValueError: map or log cannot be read; an option contradicts another, or the
            log; the initial pose is in a wall.
    """
    if anywhere and initial is not None:
        raise ValueError("--global and --initial contradict each other, give one")
    world = load_map(map)
    start = None if initial is None else _start(world, initial)
    scans = read_scans(log, topic, odometry_topic)
    odometry = None if no_odometry else scans.odometry
    readings = stacked(scans.scans(), odometry, _moments(scans, sweep, odometry))
    stamps, remarks = scan_times(scans)
    picture = picture_path(plot, out, "track.png")
    if out is not None:
        new_folder(out)
    with Run(stamps, tum, out) as run:
        scan_atlas = load_or_build_atlas(world, spacing, atlas)
        config = FollowConfig()
        if out is not None:
            settings = {
                "map": str(map.resolve()),
                "log": str(log.resolve()),
                "remarks": remarks,
                "topic": topic,
                "odometry_topic": odometry_topic,
                "odometry": odometry is not None,
                "sweep": sweep,
                "initial": None if start is None else start.tolist(),
                "atlas": asdict(scan_atlas.config),
                "follow": asdict(config),
            }
            write_json(out / "config.json", settings | circumstances())
        try:
            run.record(follow(scan_atlas, readings, start, config))
        finally:
            metrics = run.metrics()
            if out is not None:
                write_json(out / "metrics.json", metrics)
            if json:
                print(dumps(metrics | {"remarks": remarks}))
            else:
                print(f"map       {map}, {area(world):.0f} m² free")
                print(f"log       {log}: {_contents(scans, odometry)}")
                print(report(metrics, remarks))
            kept = {"tum": tum, "folder": out}
            if picture is not None and run.fixes:
                draw_track(picture, world, run)
                kept |= {"picture": picture}
            for name, path in kept.items():
                if path is not None:
                    print(f"{name:10}{path}", file=sys.stderr if json else sys.stdout)


def _start(
    world: OccupancyGrid, initial: tuple[float, float, float]
) -> Float[np.ndarray, "3"]:
    """The initial pose [m, m, rad], if a lidar can be there."""
    x, y, degrees = initial
    start = np.array([x, y, np.deg2rad(degrees)])
    if not np.isfinite(start).all():
        raise ValueError(f"--initial must be three finite numbers, got {initial}")
    free = np.asarray(world.to_map(jnp.argwhere(world.free)[:, ::-1] + 0.5))
    if not np.min(np.linalg.norm(free - start[:2], axis=1)) <= _IN_A_WALL:
        raise ValueError(
            f"--initial {x:g} {y:g} is off the map or inside a wall, over {_IN_A_WALL} "
            "m from free space; leave it out to have the lidar found"
        )
    return start


def _moments(
    log: ScanLog, sweep: str, odometry: np.ndarray | None
) -> Float[np.ndarray, "scans rays"] | None:
    """When each ray was taken, for `Reading`; None if nobody wants to know."""
    if sweep == "none":
        return None
    if log.ray_times is None or log.stamps is None:
        raise ValueError(
            f"--sweep {sweep}: the log does not say when its rays were taken; "
            "leave --sweep out"
        )
    if odometry is None and np.nanmax(log.ray_times) > 0:
        raise ValueError(
            f"--sweep {sweep} needs odometry here: rays are timed after the scan's "
            "stamp, and a motion guessed from the poses before would make them swing"
        )
    times = log.reversed_sweep().ray_times if sweep == "reversed" else log.ray_times
    return moments(log.stamps, np.asarray(times))


def _contents(log: ScanLog, odometry: np.ndarray | None) -> str:
    """What is in a log, in words."""
    words = [f"{len(log)} scans of {log.ranges.shape[1]} rays"]
    if log.stamps is not None and np.isfinite(log.stamps).any():
        words.append(f"{np.nanmax(log.stamps) - np.nanmin(log.stamps):.0f} s")
    words.append("no odometry" if odometry is None else "odometry")
    return ", ".join(words)


def report(metrics: dict, remarks: list[str]) -> str:
    """A run's metrics for people."""
    count, step, compiling = (metrics[k] for k in ("count", "step_ms", "compiling"))
    last = metrics["last"]
    lines = [
        f"track     {metrics['computed']} of {metrics['scans']} scans: "
        f"{count['tracking']} tracked, {count['localised']} found on the whole map, "
        f"{count['skipped']} skipped, {count['doubted']} doubted, {count['lost']} lost",
        f"found     {_found(metrics)}",
    ]
    if step["median"] is not None:
        lines.append(
            f"step      median {step['median']:.1f} ms, p99 {step['p99']:.1f} ms, but "
            f"{compiling['seconds']:.1f} s for {compiling['scans']} that had to compile"
        )
    lines.append(f"distance  {metrics['distance_m']:.1f} m")
    if last is not None:
        covariance = np.diag(np.square(last["sigma"]))
        place = pose_in_words(last["pose"], covariance)
        lines.append(f"pose      {place} at scan {last['scan']}")
    return "\n".join([*lines, *(f"remark    {remark}" for remark in remarks)])


def _found(metrics: dict) -> str:
    """Where in the log the lidar was found, and how often it got lost."""
    at, times = metrics["localised_at"], metrics["times_lost"]
    if metrics["last"] is None:
        return "never; is this the map of the place?"
    some = ", ".join(map(str, at[:5])) + (", …" if len(at) > 5 else "")
    words = f"at scan {some}" if at else "from the initial pose on"
    return f"{words}; got lost {times} times" if times else f"{words}; never lost"


def draw_track(path: Path, world: OccupancyGrid, run: Run) -> None:
    """The way on the map, in a file."""
    from fsmsm_jax.plotting import plot_track

    save_picture(path, lambda ax: plot_track(ax, world, run.track()))
