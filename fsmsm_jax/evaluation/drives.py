"""Simulated drives: a robot crosses a map, with scans, odometry and the truth.

Trackers and filters are judged over a whole way, and the truth of a way is known in
simulation only. `drive` sends a differential drive along a way (`plan`): it steers
towards a point a little ahead (pure pursuit), drives slower in bends, and turns on the
spot where the way does.

What comes back is what a robot would have recorded. Odometry lives in a frame of its
own, somewhere else and turned, and its errors add up (`localisation.motion`); scans are
cast from the true poses and made noisy by the `Lidar`, people included if it has
`outliers`. The same key gives the same drive.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.ways import plan as plan
from fsmsm_jax.localisation.motion import OdometryModel, lidar_poses, sample
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Drive", "drive", "plan", "record"]

_AHEAD = 0.3  # [m] the robot steers towards the point of the way this far ahead
_ON_THE_SPOT = 1.0  # [rad]: if that point is farther to the side, turn and do not drive
_TICK = 0.02  # [s] of the simulated steering, at most
_IN_VAIN = 20.0  # times longer than the way takes at full speed: give up
_SCANS = 64  # cast together
_WHEELS = OdometryModel(  # that seldom slip
    turn_per_turn=0.05,
    turn_per_metre=0.02,
    metre_per_metre=0.05,
    metre_per_turn=0.01,
    floor=(0.001, 0.001),
    drift=(0.01, 0.005),
)
_START = (-31.0, 17.0, 2.0)  # where odometry begins to count: anywhere but the origin


class Drive(NamedTuple):
    """What a robot recorded on its way, and the truth."""

    poses: Float[Array, "times 3"]
    """True poses of the lidar in the map [m, m, rad]."""
    odometry: Float[Array, "times 3"]
    """Poses of the lidar as odometry counts them, in a frame of its own [m, m, rad]."""
    scans: Scan
    """One scan a time, stacked: ranges (times, rays)."""
    stamps: Float[np.ndarray, "times"]
    """Times [s], from 0."""


def drive(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    lidar: Lidar,
    way: Float[np.ndarray, "points 2"],
    speed: float = 0.5,
    turn_rate: float = 1.0,
    rate_hz: float = 5.0,
    odometry_model: OdometryModel = _WHEELS,
    start_heading: float | None = None,
    pose_base_lidar: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Drive:
    """Drive along a way and record it.

    Args:
        key: of all noise; the path itself does not depend on it.
        world: the map, which is the truth.
        lidar: the sensor.
        way: corners of the way in the map frame [m], as `plan` returns them.
        speed: of the robot on a straight line [m/s].
        turn_rate: at most, in bends and on the spot [rad/s].
        rate_hz: scans a second.
        odometry_model: how wrong odometry is, from scan to scan.
        start_heading: of the robot in the map [rad]; along the way if left out.
        pose_base_lidar: how the lidar sits in the robot [m, m, rad].

    Returns:
        One record a scan, the first where the way begins, before moving; the last
        within 5 cm of its end.

    Raises:
        ValueError: the way has fewer than two points or is not finite; speed, turn rate
            or scan rate are not positive; the robot cannot follow the way.
    """
    way = np.asarray(way, float)
    if way.ndim != 2 or way.shape[0] < 2 or way.shape[1] != 2:
        raise ValueError(f"a way is (points ≥ 2, 2) corners, got shape {way.shape}")
    if not np.isfinite(way).all():
        raise ValueError("a corner of the way is not finite")
    if not min(speed, turn_rate, rate_hz) > 0:
        raise ValueError(
            "speed, turn_rate and rate_hz must be positive, got "
            f"{speed}, {turn_rate} and {rate_hz}"
        )
    bases = _followed(way, speed, turn_rate, rate_hz, start_heading)
    mount = jnp.asarray(pose_base_lidar, float)
    poses = lidar_poses(jnp.asarray(bases, float), mount)
    odometry, scans = record(key, world, lidar, poses, odometry_model, mount)
    return Drive(poses, odometry, scans, np.arange(len(bases)) / rate_hz)


def _followed(way, speed, turn_rate, rate_hz, heading):
    """Poses of the base at each scan, by pure pursuit."""
    legs = np.diff(way, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    corner_at = np.concatenate([[0.0], np.cumsum(lengths)])
    if not corner_at[-1] > 0:
        raise ValueError("the way has no length")
    if heading is None:
        first = legs[lengths > 0][0]
        heading = math.atan2(first[1], first[0])
    x, y = way[0]
    ticks = max(1, math.ceil(1 / (rate_hz * _TICK)))
    tick = 1 / (rate_hz * ticks)
    turns = 2 * math.pi * len(way) / turn_rate
    patience = math.ceil((_IN_VAIN * (corner_at[-1] / speed + turns)) / tick)
    close = min(0.05, corner_at[-1] / 4)

    poses, travelled = [(x, y, heading)], 0.0
    for count in range(1, patience + 1):
        # How far along the way the robot is: it only ever gets farther.
        ahead = travelled + np.linspace(0, speed * tick * 4, 9)
        here = np.stack([np.interp(ahead, corner_at, way[:, i]) for i in (0, 1)])
        travelled = ahead[np.argmin(np.hypot(here[0] - x, here[1] - y))]
        aim = min(travelled + _AHEAD, corner_at[-1])
        to = [np.interp(aim, corner_at, way[:, i]) - at for i, at in ((0, x), (1, y))]
        distance = max(math.hypot(*to), 1e-9)
        if aim == corner_at[-1] and distance < close:
            poses.append((x, y, heading))
            break
        aside = math.remainder(math.atan2(to[1], to[0]) - heading, 2 * math.pi)
        if abs(aside) > _ON_THE_SPOT:
            v, turning = 0.0, math.copysign(turn_rate, aside)
        else:
            curvature = 2 * math.sin(aside) / distance
            v = min(speed, turn_rate / max(abs(curvature), 1e-9), distance / tick)
            turning = v * curvature
        middle = heading + turning * tick / 2
        arc = np.sinc(turning * tick / (2 * math.pi)) * v * tick
        x, y = x + arc * math.cos(middle), y + arc * math.sin(middle)
        heading = heading + turning * tick
        if count % ticks == 0:
            poses.append((x, y, heading))
    else:
        raise ValueError(
            "the robot cannot follow the way; corners lie too close together for "
            f"{_AHEAD} m of foresight, or the turn rate is too small"
        )
    poses = np.array(poses)
    poses[:, 2] = np.remainder(poses[:, 2] + math.pi, 2 * math.pi) - math.pi
    return poses


@jax.jit
def record(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    lidar: Lidar,
    poses: Float[Array, "times 3"],
    odometry_model: OdometryModel = _WHEELS,
    pose_base_lidar: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, "times 3"], Scan]:
    """What a robot records along known poses: odometry and scans, both noisy.

    Under `vmap` over keys the rays are cast once for all: a hundred repetitions of one
    drive cost little more than one.

    Args:
        key: of all noise.
        world: the map, which is the truth.
        lidar: the sensor.
        poses: true poses of the lidar in the map [m, m, rad].
        odometry_model: how wrong odometry is, from pose to pose.
        pose_base_lidar: how the lidar sits in the robot, whose wheels are counted.

    Returns:
        Poses of the lidar as odometry counts them [m, m, rad], in a frame of its own,
        and one scan a pose, stacked.
    """
    key_odometry, key_scans = jax.random.split(key)
    mount = jnp.zeros(3, poses.dtype) if pose_base_lidar is None else pose_base_lidar
    bases = lidar_poses(poses, geometry.inverse(mount))
    steps = jax.vmap(geometry.between)(bases[:-1], bases[1:])
    keys = jax.random.split(key_odometry, len(steps))
    counted = jax.vmap(sample, (0, None, 0))(keys, odometry_model, steps)

    def add(pose, step):
        pose = geometry.compose(pose, step)
        return pose, pose

    start = jnp.asarray(_START, poses.dtype)
    _, odometry = jax.lax.scan(add, start, counted)
    odometry = jnp.concatenate([start[None], odometry])

    see = lambda pose: raycast(world, pose, lidar.bearings, lidar.range_max)
    # Whole blocks: a remainder would be compiled by itself.
    blocks = jnp.pad(poses, ((0, -len(poses) % _SCANS), (0, 0)), mode="edge")
    exact = jax.lax.map(see, blocks, batch_size=_SCANS)[: len(poses)]
    keys = jax.random.split(key_scans, len(poses))
    return lidar_poses(odometry, mount), jax.vmap(lidar.measure)(keys, exact)
