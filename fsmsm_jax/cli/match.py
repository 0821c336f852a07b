"""`fsmsm match`: about here, says the user; exactly where, says the scan."""

import sys
from json import dumps
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from fsmsm_jax.alignment.fast import FastConfig
from fsmsm_jax.alignment.fsmsm_config import FsmsmConfig
from fsmsm_jax.alignment.match import Match, match as match_scan
from fsmsm_jax.cli.console import (
    area,
    pose_in_words,
    save_picture,
    summary,
    tell_remarks,
    timed,
)
from fsmsm_jax.geometry import transform_points
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.ros_map import load_map

_BEFORE = "#8f8f8f"  # the scan as seen from the estimate
_MARGIN = 0.5  # [m] around the end points


def match(
    map: Annotated[Path, tyro.conf.Positional],
    log: Annotated[Path, tyro.conf.Positional],
    *,
    initial: Annotated[
        tuple[float, float, float], tyro.conf.arg(metavar="X Y DEGREES")
    ],
    index: int = 0,
    topic: str | None = None,
    rays: int = 360,
    published: float | None = None,
    json: bool = False,
    picture: Path = Path("match.png"),
) -> None:
    """Say where one scan of a log was taken, given about where.

    Args:
        map: map_server map, a YAML file beside its image.
        log: rosbag, CARMEN log or .npz with ranges, angle_min and angle_increment.
        initial: about where the lidar stands in the map, in metres and degrees.
        index: which scan of the log, from 0; negative counts from the end.
        topic: which LaserScan topic of a rosbag that has several.
        rays: how many rays a turn the scans are compared with.
        published: match as the thesis's program did, told the noise of ranges and map
            in metres: it starts again until CAER is under four times that.
        json: print one JSON object instead of text.
        picture: where to write the picture; none for no picture.
    """
    world = load_map(map)
    scans = read_scans(log, topic)
    tell_remarks(scans)
    scan = scans.scan(index)
    x, y, degrees = initial
    start = jnp.array([x, y, np.deg2rad(degrees)])
    config = FastConfig()
    if published is not None:
        config = FsmsmConfig.published(sigma_range=published)
    once = lambda: match_scan(world, scan, start, config, rays=rays)
    found, first = timed(once)
    _, warm = timed(once)
    if json:
        print(dumps(_as_json(found, {"first_match": first, "match": warm})))
    else:
        verdict = "converged" if found.converged else "not converged"
        print(f"map       {map}, {area(world):.0f} m² free")
        print(f"scan      {index} of {log}: {summary(scan)}")
        print(f"initial   x {x:.3f} m, y {y:.3f} m, heading {degrees:.2f}°")
        print(f"match     {first:.2f} s the first time, then {1e3 * warm:.0f} ms\n")
        print(f"pose      {pose_in_words(found.pose, found.covariance)}")
        print(
            f"verdict   {verdict} in {found.iterations} iterations, {found.scans} "
            f"virtual scans: CAER {100 * float(found.caer_before):.1f} → "
            f"{100 * float(found.caer_per_ray):.1f} cm per ray, "
            f"{float(found.agreement):.0%} of the rays agree"
        )
    if picture != Path("none"):
        _draw(picture, world, scan, start, found)
        print(f"picture   {picture}", file=sys.stderr if json else sys.stdout)


def _as_json(found: Match, seconds: dict[str, float]) -> dict:
    """The result for programs, in metres, radians and seconds."""
    numbers = {
        name: np.asarray(value).tolist()
        for name, value in zip(found._fields, found, strict=True)
    }
    sigma = np.sqrt(np.diagonal(np.asarray(found.covariance, float))).tolist()
    return numbers | {"sigma": sigma, "seconds": seconds}


def _draw(
    path: Path,
    world: OccupancyGrid,
    scan: Scan,
    start: Float[Array, "3"],
    found: Match,
) -> None:
    """End points on the map: grey from the estimate, red from the pose found."""
    from fsmsm_jax.plotting import plot_pose, plot_scan, plot_world

    def draw(ax):
        plot_world(ax, world)
        for artist in plot_scan(ax, scan, start):
            artist.set_color(_BEFORE)
        plot_pose(ax, start, _BEFORE)
        plot_scan(ax, scan, found.pose)
        plot_pose(ax, found.pose)
        ends = [
            transform_points(pose, scan.points)[scan.echo]
            for pose in (start, found.pose)
        ]
        ends = np.concatenate(ends)
        (left, low), (right, high) = (
            ends.min(axis=0) - _MARGIN,
            ends.max(axis=0) + _MARGIN,
        )
        ax.set(xlim=(left, right), ylim=(low, high), xlabel="x [m]", ylabel="y [m]")
        verdict = "Converged" if found.converged else "Not converged"
        x, y, theta = np.asarray(found.pose, float)
        ax.set_title(f"{verdict}: x {x:.2f} m, y {y:.2f} m, θ {np.rad2deg(theta):.1f}°")

    save_picture(path, draw)
