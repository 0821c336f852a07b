"""Milliseconds a step, beside a particle filter that others wrote."""

import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table, number

from fsmsm_jax import geometry, tracker
from fsmsm_jax.localisation.track import stacked
from tracking.recordings import MAC, Recording, load

RAYS = 360


def steps(options) -> Iterator[Table]:
    """`tracker.step`, compiled, scan by scan, as a robot would call it."""
    if options.data is None:
        return
    rows = []
    for name in ("freiburg-079", "intel", MAC):
        recording = load(options.data, name)
        every = 1 if name != MAC else recording.log.ranges.shape[1] // RAYS
        rows.append((name, *_timed(recording, every, 200 if options.quick else 2000)))
    head = ("log", "rays", "steps", "median [ms]", "p99 [ms]", "first, compiling [s]")
    yield Table(
        "A step of the tracker",
        head,
        rows,
        "The author's C++ takes about 80 ms a step, by the issue; not run here.",
    )


def _timed(recording: Recording, every: int, count: int):
    first = int(recording.scored[0])
    rows = np.arange(first, min(first + count, len(recording.reference)))
    scans = recording.log.scans(rows)
    scans = jax.tree.map(lambda a: a[:, ::every] if a.ndim == 2 else a, scans)
    state = tracker.init(recording.world, jnp.asarray(recording.reference[first]))
    seconds = []
    counted = np.asarray(recording.log.odometry)[rows]
    for scan, odometry, _ in stacked(scans, counted):
        begun = time.perf_counter()
        state, info = tracker.step(recording.world, state, scan, odometry)
        jax.block_until_ready((state, info))
        seconds.append(time.perf_counter() - begun)
    median, late = np.percentile(1e3 * np.array(seconds[1:]), [50, 99])
    rays = scans.ranges.shape[1]
    return str(rays), str(len(seconds)), *map(number, (median, late, seconds[0]))


def amcl(options) -> Iterator[Table]:
    """The PyPI port of nav2's AMCL on the mac log, given a good pose, and ours."""
    if options.data is None:
        return
    try:
        import amcl as peer  # type: ignore[import-not-found]
    except ImportError:
        yield Table("AMCL", ("not installed: pip install amcl",), [])
        return
    recording = load(options.data, MAC)
    log, world = recording.log, recording.world
    arrays = np.load(options.data / "real" / f"{MAC}.npz")
    mount, base = arrays["laser_in_base"], arrays["odom_base"]
    compose = lambda a, b: np.asarray(geometry.compose(jnp.asarray(a), jnp.asarray(b)))
    at_base = compose(recording.reference[0], geometry.inverse(jnp.asarray(mount)))

    def localizer():
        motion = peer.MotionParameters(**{f"alpha{n}": 0.2 for n in range(1, 6)})
        laser = peer.LaserParameters(
            z_hit=0.5,
            z_short=0.05,
            z_max=0.05,
            z_rand=0.5,
            sigma_hit=0.2,
            lambda_short=0.1,
            chi_outlier=0.05,
            max_beams=60,
        )
        filter = peer.AMCL(
            min_particles=500,
            max_particles=2000,
            alpha_slow=0.001,
            alpha_fast=0.1,
            motion_params=motion,
            laser_params=laser,
            robot_model_type="differential",
        )
        cells = np.where(world.cells == 0, 0, np.where(world.cells > 0, 100, -1))
        x, y, _ = map(float, world.origin)
        resolution = float(world.resolution)
        grid = peer.create_occupancy_grid_from_list(cells.tolist(), resolution, x, y)
        filter.set_map(grid)
        filter.set_laser_pose(peer.Vector3D(*map(float, mount)))
        spread = peer.Matrix3D()
        filter.set_initial_pose(peer.Vector3D(*map(float, at_base)), spread)
        return filter

    filter, poses, seconds = localizer(), [], []
    upto = 60 if options.quick else len(log)
    for n in range(upto):
        ranges = np.where(np.isfinite(log.ranges[n]), log.ranges[n], log.range_max)
        pairs = np.stack([ranges, log.bearings[n]], axis=1).tolist()
        scan = peer.create_laser_scan_from_list(pairs, log.range_max)
        begun = time.perf_counter()
        filter.update(scan, peer.Vector3D(*map(float, base[n])))
        seconds.append(time.perf_counter() - begun)
        mean = filter.get_pose_mean()
        poses.append(compose([mean.x, mean.y, mean.theta], mount))
    position, turn = recording.errors(np.array(poses))
    theirs = ("amcl 0.1.2", *_errors(position, turn), number(1e3 * np.median(seconds)))

    state = tracker.init(world, jnp.asarray(recording.reference[0]))
    ours, times = [], []
    counted = np.asarray(log.odometry)[:upto]
    for scan, odometry, _ in stacked(log.scans(range(upto)), counted):
        begun = time.perf_counter()
        state, info = tracker.step(world, state, scan, odometry)
        ours.append(np.asarray(info.pose))
        times.append(time.perf_counter() - begun)
    position, turn = recording.errors(np.array(ours))
    mine = ("tracker", *_errors(position, turn), number(1e3 * np.median(times[1:])))
    head = ("on mac", "median [cm]", "p95", "median [°]", "an update [ms], median")
    yield Table("Beside AMCL, from the reference pose", head, [mine, theirs])


def _errors(position, turn):
    return (
        *map(number, np.percentile(100 * position, [50, 95])),
        number(np.rad2deg(np.median(turn))),
    )
