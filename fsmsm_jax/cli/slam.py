"""`fsmsm slam`: which landmarks are there, and how did the vehicle go among them?"""

import csv
import sys
from dataclasses import asdict, replace
from json import dumps
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from fsmsm_jax.cli.console import save_picture
from fsmsm_jax.cli.legs import FEWEST, drive_through
from fsmsm_jax.cli.runs import circumstances, new_folder, picture_path, write_json
from fsmsm_jax.cli.slam_report import (
    contents,
    metrics_of,
    remarks_on,
    report,
    told_ids,
)
from fsmsm_jax.io.landmarks import LandmarkLog, read_landmark_log
from fsmsm_jax.io.tum import write_tum
from fsmsm_jax.slam.association import Association
from fsmsm_jax.slam.drive import tidied
from fsmsm_jax.slam.filter import Info, SlamConfig
from fsmsm_jax.slam.landmarks import Landmarks
from fsmsm_jax.slam.methods import Name
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.simulate import Circle, scatter, simulate
from fsmsm_jax.slam.vehicle import Car

_MAP = ("landmark", "x_m", "y_m", "sigma_x_m", "sigma_y_m", "correlation", "evidence")
_STEPS = (
    *("step", "time_s", "x_m", "y_m", "heading_rad"),
    *("sigma_x_m", "sigma_y_m", "sigma_heading_rad"),
    *("effective", "landmarks", "detections", "matched", "unplaced", "explained"),
)


def slam(
    log: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    method: Name = "lslam2",
    particles: int = 40,
    landmarks: int | None = None,
    ids: bool = False,
    trim: Annotated[
        tuple[float, float] | None, tyro.conf.arg(metavar="SCALE RADIANS")
    ] = None,
    seed: int = 0,
    tum: Path | None = None,
    plot: Path | None = None,
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Map landmarks, and say how a vehicle moved among them, by one log of both.

    The log holds controls, and range and bearing of what was detected. Without a log,
    a drive is simulated. Poses are in the frame in which the log gives its start; what
    it knows of the truth is compared with and never used.

    Args:
        log: folder of the ACFR car park, of Victoria Park or of a robot of UTIAS
            MRCLAM, or .npz with controls, detections and times.
        method: what a particle draws, and when; see fsmsm_jax.slam.methods.
        particles: how many; ekf has one.
        landmarks: slots of a particle's map; else as many as it takes.
        ids: believe the log as to which landmark was detected.
        trim: true steering of a car is SCALE times what the log says, plus RADIANS.
        seed: of all draws, and of the simulated drive.
        tum: where to write the trajectory.
        plot: where to write the picture, none for no picture; else slam.png.
        out: new folder for trajectory, map, steps, metrics, picture and all settings.
        json: print one JSON object instead of text.

    Raises:
        ValueError: the log cannot be read; an option contradicts it; a folder is
            missing or full.
    """
    drive = _simulated(seed) if log is None else read_landmark_log(log)
    config = _config(drive, method, particles, landmarks, ids, trim)
    picture = picture_path(plot, out, "slam.png")
    if tum and tum.parent != out and not tum.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {tum.parent} for {tum}")
    if out is not None:
        new_folder(out)
    fixed = ids or landmarks is not None
    found = drive_through(config, drive, seed, grow=not fixed)
    metrics = metrics_of(config, drive, found)
    remarks = [*drive.remarks, *remarks_on(drive, metrics, ids)]

    poses = np.asarray(found.info.pose, float)
    if tum is not None:
        write_tum(tum, drive.times, poses)
    if out is not None:
        settings = {
            "log": None if log is None else str(log.resolve()),
            "remarks": remarks,
            "seed": seed,
            "start": drive.start,
            "slam": asdict(config),
        }
        write_json(out / "config.json", settings | circumstances())
        write_json(out / "metrics.json", metrics)
        write_tum(out / "trajectory.tum", drive.times, poses)
        _write_map(out / "map.csv", found.landmarks)
        _write_steps(out / "steps.csv", drive, found.info)
    if picture is not None:
        from fsmsm_jax.plotting.slam import plot_slam

        true = drive.reference[:, 1:] if len(drive.reference) else None
        shown = (poses, found.landmarks, true, drive.landmarks)
        save_picture(picture, lambda ax: plot_slam(ax, *shown))
    if json:
        print(dumps(metrics | {"remarks": remarks}))
    else:
        print(f"log       {log or f'simulated out of seed {seed}'}: {contents(drive)}")
        print(report(metrics, remarks))
    kept = {"tum": tum, "folder": out, "picture": picture}
    for name, path in kept.items():
        if path is not None:
            print(f"{name:10}{path}", file=sys.stderr if json else sys.stdout)


def _simulated(seed: int) -> LandmarkLog:
    """Two laps of a circle among 25 landmarks."""
    laps, car, sensor = Circle(), Car(), RangeBearing()
    world, noise = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
    places = scatter(world)
    start, controls = laps.way(car)
    drive, poses = jax.jit(simulate)(noise, places, start, controls, car, sensor)
    times = laps.seconds * np.arange(len(poses))
    true = np.asarray(poses, float)
    return LandmarkLog(
        tidied(*map(np.asarray, drive)),
        times,
        true[0],
        car,
        sensor,
        np.column_stack([times, true[:, :2]]),
        true[:, 2],
        np.asarray(places, float),
    )


def _config(
    log: LandmarkLog,
    method: Name,
    particles: int,
    landmarks: int | None,
    ids: bool,
    trim: tuple[float, float] | None,
) -> SlamConfig:
    """The filter that was asked for, if the log allows it."""
    vehicle, known = log.vehicle, told_ids(log)
    if trim is not None:
        if not isinstance(vehicle, Car):
            raise ValueError(
                "--trim mends the steering of a car, and this vehicle has none; "
                "leave it out"
            )
        if not np.isfinite(trim).all():
            raise ValueError(f"--trim must be two finite numbers, got {trim}")
        vehicle = replace(vehicle, trim=trim)
    if ids and not known.size:
        raise ValueError(
            "--ids: the log does not say which landmarks were detected; leave it out"
        )
    slots = int(known.max()) + 1 if ids else FEWEST
    return SlamConfig(
        method,
        particles,
        slots if landmarks is None else landmarks,
        vehicle,
        log.sensor,
        None if ids else Association(),
    )


def _write_map(path: Path, landmarks: Landmarks) -> None:
    """Every landmark, a row each; with --ids they are numbered as in the log."""
    known = np.flatnonzero(np.asarray(landmarks.known))
    x, y = (np.asarray(axis, float) for axis in landmarks.place)
    xx, xy, yy = (np.asarray(entry, float) for entry in landmarks.covariance)
    evidence = np.asarray(landmarks.evidence)
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(_MAP)
        for n in known:
            sigmas = np.sqrt(xx[n]), np.sqrt(yy[n])
            numbers = (*sigmas, xy[n] / np.prod(sigmas), evidence[n])
            row = [f"{x[n]:.6f}", f"{y[n]:.6f}", *(f"{a:.6g}" for a in numbers)]
            table.writerow([n, *row])


def _write_steps(path: Path, log: LandmarkLog, info: Info) -> None:
    """What became of each step, a row each."""
    variances = np.diagonal(info.covariance, axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variances, 0))
    detections = np.sum(log.drive.valid, axis=1)
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(_STEPS)
        for n, pose in enumerate(info.pose):
            numbers = [f"{a:.6g}" for a in (*sigma[n], info.effective[n])]
            counts = info.known[n], detections[n], info.matched[n], info.unplaced[n]
            place = [f"{a:.6f}" for a in pose]
            row = [n, f"{log.times[n]:.9f}", *place, *numbers, *counts]
            table.writerow([*row, info.usable[n]])
