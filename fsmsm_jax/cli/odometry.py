"""`fsmsm odometry`: how did the lidar move, with no map and no wheels?"""

import csv
import sys
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float

from fsmsm_jax.cli.console import pose_in_words, save_picture, timed
from fsmsm_jax.cli.runs import (
    circumstances,
    new_folder,
    picture_path,
    scan_times,
    write_json,
)
from fsmsm_jax.evaluation.drift import LENGTHS, drift, way
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.io.tum import read_tum, write_tum
from fsmsm_jax.localisation.lidar_odometry import LidarOdometry, lidar_odometry
from fsmsm_jax.localisation.odometer import LidarOdometryConfig

_STATUSES = ("matched", "keyframe", "skipped", "doubted")
_GAP = 1.0  # [s] between reference poses, over which none is guessed
_SAME = 1e-3  # [s]: a reference pose at the time of a scan is of that scan
_COLUMNS = (
    *("scan", "time_s", "status", "x_m", "y_m", "heading_rad"),
    *("sigma_x_m", "sigma_y_m", "sigma_heading_rad", "agreement", "known"),
)


def odometry(
    log: Annotated[Path, tyro.conf.Positional],
    *,
    tum: Path | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    reference: Path | None = None,
    topic: str | None = None,
    json: bool = False,
) -> None:
    """Say how a lidar moved through a log, by its scans alone.

    No map is needed and no wheels; where the log has odometry, the two are compared.
    Poses are in the frame of the lidar at the first scan.

    Args:
        log: rosbag, CARMEN log or .npz with ranges, angle_min and angle_increment.
        tum: where to write the trajectory.
        plot: where to write the picture, none for no picture; else odometry.png.
        out: new folder for trajectory, scans, metrics, picture and all settings.
        reference: true poses of the lidar, a TUM file in any frame, to say how far the
            way strays; a log without times counts its scans, from 0.
        topic: which LaserScan topic of a rosbag that has several.
        json: print one JSON object instead of text.

    Raises:
        ValueError: log or reference cannot be read; a folder is missing or full.
    """
    scans = read_scans(log, topic)
    stamps, remarks = scan_times(scans)
    truth = None if reference is None else _at_scans(stamps, reference)
    picture = picture_path(plot, out, "odometry.png")
    if tum and tum.parent != out and not tum.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {tum.parent} for {tum}")
    if out is not None:
        new_folder(out)
    config, readings = LidarOdometryConfig(), scans.scans()
    found, seconds = timed(lambda: lidar_odometry(readings, config))
    metrics = _metrics(found, seconds, scans.odometry, truth)

    timed_rows = np.isfinite(stamps)
    if tum is not None:
        write_tum(tum, stamps[timed_rows], found.pose[timed_rows])
    if out is not None:
        settings = {
            "log": str(log.resolve()),
            "reference": None if reference is None else str(reference.resolve()),
            "remarks": remarks,
            "topic": topic,
            "odometry": asdict(config),
        }
        write_json(out / "config.json", settings | circumstances())
        write_json(out / "metrics.json", metrics)
        write_tum(out / "trajectory.tum", stamps[timed_rows], found.pose[timed_rows])
        _write_scans(out / "scans.csv", stamps, found)
    if picture is not None:
        _draw(picture, found, readings, scans.odometry, truth)
    if json:
        print(dumps(metrics | {"remarks": remarks}))
    else:
        print(f"log       {log}: {len(scans)} scans of {scans.ranges.shape[1]} rays")
        print(report(metrics, remarks))
    kept = {"tum": tum, "folder": out, "picture": picture}
    for name, path in kept.items():
        if path is not None:
            print(f"{name:10}{path}", file=sys.stderr if json else sys.stdout)


def _at_scans(
    stamps: Float[np.ndarray, "scans"], path: Path
) -> Float[np.ndarray, "scans 3"]:
    """Reference poses at the times of the scans, NaN where there are none."""
    times, poses = read_tum(path)
    if not times.size:
        raise ValueError(f"{path.name} holds no poses")
    order = np.argsort(times, kind="stable")
    times, poses = times[order], poses[order]
    poses[:, 2] = np.unwrap(poses[:, 2])
    nearest = np.clip(np.searchsorted(times, stamps - _SAME), 0, len(times) - 1)
    after = np.clip(np.searchsorted(times, stamps), 1, max(len(times) - 1, 1))
    exact = np.abs(times[nearest] - stamps) <= _SAME
    between = np.zeros_like(exact)
    if len(times) > 1:
        before = after - 1
        between = (times[before] <= stamps) & (stamps <= times[after])
        between &= times[after] - times[before] <= _GAP
    known = exact | between
    if not known.any():
        raise ValueError(
            f"{path.name} has no pose at the time of any scan: its times go from "
            f"{times[0]:.3f} to {times[-1]:.3f} s, the log's from "
            f"{np.nanmin(stamps):.3f} to {np.nanmax(stamps):.3f} s"
        )
    there = np.stack([np.interp(stamps, times, column) for column in poses.T], axis=1)
    there = np.where(exact[:, None], poses[nearest], there)
    return np.where(known[:, None], there, np.nan)


def _metrics(
    found: LidarOdometry,
    seconds: float,
    wheels: np.ndarray | None,
    truth: np.ndarray | None,
) -> dict:
    """The run in numbers, for JSON."""
    count = {name: int(np.sum(found.status == name)) for name in _STATUSES}
    sigma = np.sqrt(np.diagonal(found.covariance[-1]))
    last = {"pose": found.pose[-1].tolist(), "sigma": sigma.tolist()}
    compared = {}
    if wheels is not None:
        compared["wheels_against_scans"] = _drift(wheels, found.pose)
    if truth is not None:
        compared["scans_against_reference"] = _drift(found.pose, truth)
        if wheels is not None:
            compared["wheels_against_reference"] = _drift(wheels, truth)
    return {
        "scans": len(found.pose),
        "count": count,
        "distance_m": float(way(found.pose)[-1]),
        "agreement": float(np.median(found.agreement)),
        "seconds": seconds,
        "last": last,
        "drift": compared,
    }


def _drift(poses: np.ndarray, reference: np.ndarray) -> dict | None:
    """Percent and degrees a metre; None where the way is too short to say."""
    found = drift(poses, reference)
    if not len(found.length):
        return None
    metres, radians = found.mean()
    return {
        "percent": 100 * metres,
        "degrees_per_metre": float(np.rad2deg(radians)),
        "lengths_m": [length for length in LENGTHS if length in found.wanted],
        "sub_paths": len(found.length),
    }


def _write_scans(path: Path, stamps: np.ndarray, found: LidarOdometry) -> None:
    """What became of each scan, a row each."""
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for n, pose in enumerate(found.pose):
            place = [f"{number:.6f}" for number in pose]
            judged = (*sigma[n], found.agreement[n], found.known[n])
            numbers = [f"{number:.6g}" for number in judged]
            table.writerow([n, f"{stamps[n]:.9f}", found.status[n], *place, *numbers])


def report(metrics: dict, remarks: list[str]) -> str:
    """A run's metrics for people."""
    count, last = metrics["count"], metrics["last"]
    place = pose_in_words(last["pose"], np.diag(np.square(last["sigma"])))
    lines = [
        f"odometry  {metrics['scans']} scans: {count['matched']} matched, "
        f"{count['keyframe']} kept as keyframes, {count['skipped']} "
        f"skipped, {count['doubted']} doubted; {metrics['seconds']:.1f} s",
        f"distance  {metrics['distance_m']:.1f} m",
        *(f"drift     {_in_words(*pair)}" for pair in metrics["drift"].items()),
        f"pose      {place} at the last scan",
    ]
    return "\n".join([*lines, *(f"remark    {remark}" for remark in remarks)])


def _in_words(name: str, found: dict | None) -> str:
    one, other = name.split("_against_")
    if found is None:
        return f"{one} against {other}: the way is too short to say"
    lengths = ", ".join(f"{length:g}" for length in found["lengths_m"])
    return (
        f"{one} against {other}: {found['percent']:.2f} % and "
        f"{found['degrees_per_metre']:.3f} °/m over sub-paths of {lengths} m"
    )


def _draw(path, found, readings, wheels, truth):
    """The way and what the keyframes saw, in a file."""
    from fsmsm_jax.plotting.odometry import plot_odometry

    kept = np.flatnonzero(found.status == "keyframe")
    ranges, bearings = np.asarray(readings.ranges), np.asarray(readings.bearings)
    echo = np.asarray(readings.echo)[kept]
    headings = found.pose[kept, 2, None] + bearings[kept]
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    walls = found.pose[kept, None, :2] + ranges[kept, :, None] * ahead
    draw = lambda ax: plot_odometry(ax, found, walls[echo], wheels, truth)
    save_picture(path, draw)
