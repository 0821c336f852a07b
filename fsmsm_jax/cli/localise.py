"""`fsmsm localise`: where on the map was this scan taken?"""

import sys
import time
from json import dumps
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from fsmsm_jax.cli.console import (
    area,
    pose_in_words,
    save_picture,
    summary,
    tell_remarks,
    timed,
    without_tracing,
)
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.io.stored import ANSWER
from fsmsm_jax.localisation import search
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas
from fsmsm_jax.localisation.atlas_build import build_atlas
from fsmsm_jax.localisation.settle import Localisation, SearchConfig
from fsmsm_jax.sensing.buckets import padded
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.ros_map import load_map


def localise(
    map: Annotated[Path, tyro.conf.Positional],
    log: Annotated[Path, tyro.conf.Positional],
    *,
    index: int = 0,
    topic: str | None = None,
    json: bool = False,
    picture: Path = Path("localise.png"),
    spacing: float = 0.8,
    atlas: Path | None = None,
    max_memory: float = np.inf,
) -> None:
    """Say where on a map one scan of a log was taken.

    Args:
        map: map_server map, a YAML file beside its image.
        log: rosbag, CARMEN log or .npz with ranges, angle_min and angle_increment.
        index: which scan of the log, from 0; negative counts from the end.
        topic: which LaserScan topic of a rosbag that has several.
        json: print one JSON object instead of text.
        picture: where to write the picture; none for no picture.
        spacing: distance between the positions of the atlas in metres.
        atlas: file that keeps the atlas: loaded if it is there, else built and saved.
        max_memory: megabytes that the atlas may hold.
    """
    world = load_map(map)
    scans = read_scans(log, topic)
    tell_remarks(scans)
    scan = scans.scan(index)
    scan_atlas, atlas_time = timed(
        lambda: load_or_build_atlas(world, spacing, atlas, max_memory)
    )
    result, first, warm = localise_twice(scan_atlas, scan)
    timing = {"atlas": atlas_time, "first_query": first, "query": warm}
    if json:
        print(dumps(_as_json(result, timing)))
    else:
        print(f"map       {map}, {area(world):.0f} m² free")
        print(f"scan      {index} of {log}: {summary(scan)}")
        print(report(result, timing))
    if picture != Path("none"):
        draw_localisation(picture, world, scan, result)
        print(f"picture   {picture}", file=sys.stderr if json else sys.stdout)


def load_or_build_atlas(
    world: OccupancyGrid, spacing: float, path: Path | None, max_memory: float = np.inf
) -> ScanAtlas:
    """The atlas in the file, or a new one, which then goes into the file.

    Raises:
        ValueError: it cannot be read or built, or is larger than so many megabytes.
    """
    if path is None or not path.exists():
        config = AtlasConfig(spacing=spacing)
        cap = 1e6 * max_memory
        return build_atlas(world, config, max_memory=cap, progress=True, file=path)
    atlas = ScanAtlas.load(path, world)
    if atlas.nbytes > 1e6 * max_memory:
        raise ValueError(
            f"the atlas in {path} holds {atlas.nbytes / 1e6:.1f} MB and may hold "
            f"{max_memory:g}; remove it, and a new one will be built"
        )
    return atlas


def localise_twice(atlas: ScanAtlas, scan: Scan) -> tuple[Localisation, float, float]:
    """The result, and the seconds of a query with compilation and of one without."""
    search.check_echoes(scan, atlas.config.reach)
    start = time.perf_counter()
    asked = atlas, padded(scan), SearchConfig()
    query = without_tracing(search.query, asked, ANSWER)
    result = jax.block_until_ready(query())
    first = time.perf_counter() - start
    _, warm = timed(query)
    return jax.device_get(result), first, warm


def report(result: Localisation, timing: dict[str, float]) -> str:
    """The result for people."""
    verdict = "confident" if result.confident else "not confident"
    lines = [
        f"atlas     {timing['atlas']:.2f} s",
        f"query     {timing['first_query']:.2f} s the first time, then "
        f"{1e3 * timing['query']:.0f} ms",
        "",
        f"pose      {pose_in_words(result.pose, result.covariance)}",
        f"verdict   {verdict}: CAER {100 * float(result.caer_per_ray):.1f} cm per ray, "
        f"the map explains {float(result.explained):.0%} of the rays",
    ]
    for candidate in _candidates(result)[1:2]:
        x, y, theta = candidate["pose"]
        lines.append(
            f"runner-up x {x:.2f} m, y {y:.2f} m, heading {np.rad2deg(theta):.1f}°: "
            f"CAER {100 * candidate['caer_per_ray']:.1f} cm per ray"
        )
    return "\n".join(lines)


def _candidates(result: Localisation) -> list[dict]:
    """The distinct places, best first; duplicates, of score −inf, are left out."""
    rows = zip(*(np.asarray(a).tolist() for a in result.candidates), strict=True)
    return [
        {"pose": pose, "score": score, "likelihood": likelihood, "caer_per_ray": caer}
        for pose, score, likelihood, caer in rows
        if np.isfinite(score)
    ]


def _as_json(result: Localisation, timing: dict[str, float]) -> dict:
    """The result for programs, in metres, radians and seconds."""
    sigma = np.sqrt(np.diagonal(np.asarray(result.covariance, float)))
    return {
        "pose": np.asarray(result.pose).tolist(),
        "sigma": sigma.tolist(),
        "covariance": np.asarray(result.covariance).tolist(),
        "caer_per_ray": float(result.caer_per_ray),
        "explained": float(result.explained),
        "confident": bool(result.confident),
        "candidates": _candidates(result),
        "seconds": timing,
    }


def draw_localisation(path: Path, world, scan: Scan, result: Localisation, truth=None):
    """The picture of `plot_localisation`, in a file."""
    from fsmsm_jax.plotting.localisation import plot_localisation

    save_picture(path, lambda ax: plot_localisation(ax, world, scan, result, truth))
