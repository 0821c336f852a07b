"""The command line: `fsmsm localise MAP LOG`, and `fsmsm demo` to see it work.

Both end in a picture. `localise` reads a map_server map and one scan of a log (rosbag,
CARMEN or .npz) and says where it was taken, how surely, and what else it could have
been; `--json` says so to a program. Text and JSON go to stdout, progress to stderr. An
error is one line on stderr and exit status 2.

Compiled programs are kept in $XDG_CACHE_HOME/fsmsm_jax (~/.cache/fsmsm_jax), which
takes seconds off every run but the first; FSMSM_NO_CACHE=1 turns that off, and
JAX_COMPILATION_CACHE_DIR moves it.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from json import dumps
from pathlib import Path
from typing import Annotated, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax.geometry import between
from fsmsm_jax.io.logs import read_scans
from fsmsm_jax.localisation.atlas import AtlasConfig, ScanAtlas, build_atlas
from fsmsm_jax.localisation.search import Localisation, localise as localise_scan
from fsmsm_jax.sensing.lidar import Lidar, Scan
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.buildings import office
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.ros_map import load_map

__all__ = ["demo", "localise", "main"]

_CLEARANCE = 0.4  # [m] the demo's robot keeps from walls
_T = TypeVar("_T")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, or 2 after an error."""
    try:
        _keep_compiled_programs()
        tyro.extras.subcommand_cli_from_dict(
            {"localise": localise, "demo": demo},
            prog="fsmsm",
            description="Where is my lidar? 2D lidar localisation against a map.",
            args=arguments,
            config=(
                tyro.conf.FlagCreatePairsOff,
                tyro.conf.PositionalMetavarFromFieldName,
            ),
        )
    except (ValueError, OSError, ImportError) as error:
        print(f"fsmsm: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


def localise(
    map: Annotated[Path, tyro.conf.Positional],
    log: Annotated[Path, tyro.conf.Positional],
    *,
    index: int = 0,
    topic: str | None = None,
    json: bool = False,
    picture: Path = Path("localise.png"),
    spacing: float = 0.4,
    atlas: Path | None = None,
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
    """
    world = load_map(map)
    scan = read_scans(log, topic).scan(index)
    scan_atlas, atlas_time = _timed(lambda: _atlas(world, spacing, atlas))
    result, first, warm = _localise_twice(scan_atlas, scan)
    timing = {"atlas": atlas_time, "first_query": first, "query": warm}
    if json:
        print(dumps(_as_json(result, timing)))
    else:
        print(f"map       {map}, {_area(world):.0f} m² free")
        print(f"scan      {index} of {log}: {_summary(scan)}")
        print(_report(result, timing))
    if picture != Path("none"):
        _draw(picture, world, scan, result)
        print(f"picture   {picture}", file=sys.stderr if json else sys.stdout)


def demo(seed: int = 0, picture: Path = Path("demo.png")) -> None:
    """Get lost in a made-up office building and be found again.

    The scan covers 270°, and a third of its rays end on people and boxes that are not
    on the map.

    Args:
        seed: which building, which place in it, and which noise.
        picture: where to write the picture.
    """
    world = office(seed)
    key_pose, key_scan = jax.random.split(jax.random.key(seed))
    truth = _random_pose(key_pose, world)
    lidar = Lidar.create(rays=360, field_of_view=1.5 * np.pi, noise=0.02, outliers=0.2)
    scan = lidar.measure(key_scan, raycast(world, truth, lidar.bearings))
    print(f"map       an office floor out of seed {seed}, {_area(world):.0f} m² free")
    print(
        f"scan      {_summary(scan)}, noise 2 cm, 20 % of the rays blocked", flush=True
    )
    scan_atlas, atlas_time = _timed(lambda: _atlas(world, 0.25, None))
    result, first, warm = _localise_twice(scan_atlas, scan)
    print(_report(result, {"atlas": atlas_time, "first_query": first, "query": warm}))
    x, y, theta = np.asarray(truth, float)
    error = np.asarray(between(truth, result.pose), float)
    print(
        f"truth     x {x:.3f} m, y {y:.3f} m, heading {np.rad2deg(theta):.2f}°: off by "
        f"{1e3 * np.hypot(*error[:2]):.0f} mm and {abs(np.rad2deg(error[2])):.2f}°"
    )
    _draw(picture, world, scan, result, truth)
    print(f"picture   {picture}")


def _keep_compiled_programs() -> None:
    """Point JAX's compilation cache at the user's folder, if that can be written."""
    if {"FSMSM_NO_CACHE", "JAX_COMPILATION_CACHE_DIR"} & os.environ.keys():
        return
    root = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(root) / "fsmsm_jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _timed(function: Callable[[], _T]) -> tuple[_T, float]:
    """What the function returns, once it is computed, and the seconds that took."""
    start = time.perf_counter()
    value = jax.block_until_ready(function())
    return value, time.perf_counter() - start


def _atlas(world: OccupancyGrid, spacing: float, path: Path | None) -> ScanAtlas:
    """The atlas in the file, or a new one, which then goes into the file."""
    if path is not None and path.exists():
        return ScanAtlas.load(path, world)
    atlas = build_atlas(world, AtlasConfig(spacing=spacing), progress=True)
    if path is not None:
        atlas.save(path)
    return atlas


def _localise_twice(atlas: ScanAtlas, scan: Scan) -> tuple[Localisation, float, float]:
    """The result, and the seconds of a query with compilation and of one without."""
    result, first = _timed(lambda: localise_scan(atlas, scan))
    _, warm = _timed(lambda: localise_scan(atlas, scan))
    return result, first, warm


def _random_pose(key: PRNGKeyArray, world: OccupancyGrid) -> Float[Array, "3"]:
    """A pose [m, m, rad] uniform over the free space that keeps clear of walls."""
    key_cell, key_heading = jax.random.split(key)
    cells = jnp.argwhere(world.free & (world.distance > _CLEARANCE))
    row, column = cells[jax.random.randint(key_cell, (), 0, len(cells))]
    position = world.to_map(jnp.stack([column, row]) + 0.5)
    heading = jax.random.uniform(key_heading, (1,), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.concatenate([position, heading])


def _draw(
    path: Path,
    world: OccupancyGrid,
    scan: Scan,
    result: Localisation,
    truth: Float[Array, "3"] | None = None,
) -> None:
    from matplotlib.figure import Figure

    from fsmsm_jax.plotting import plot_localisation

    figure = Figure(figsize=(9, 7))
    plot_localisation(figure.add_subplot(), world, scan, result, truth)
    figure.savefig(path, dpi=160, bbox_inches="tight", facecolor="white")


def _area(world: OccupancyGrid) -> float:
    """Free space [m²]."""
    return float(world.free.sum() * world.resolution**2)


def _summary(scan: Scan) -> str:
    bearings = np.unwrap(np.asarray(scan.bearings))
    view = np.rad2deg(np.ptp(bearings))
    return f"{scan.ranges.size} rays over {view:.0f}°, {int(scan.echo.sum())} echoes"


def _report(result: Localisation, timing: dict[str, float]) -> str:
    """The result for people."""
    x, y, theta = np.asarray(result.pose, float)
    sx, sy, st = np.sqrt(np.diagonal(np.asarray(result.covariance, float)))
    verdict = "confident" if result.confident else "not confident"
    lines = [
        f"atlas     {timing['atlas']:.2f} s",
        f"query     {timing['first_query']:.2f} s the first time, then "
        f"{1e3 * timing['query']:.0f} ms",
        "",
        f"pose      x {x:.3f} m ± {sx:.3f}, y {y:.3f} m ± {sy:.3f}, "
        f"heading {np.rad2deg(theta):.2f}° ± {np.rad2deg(st):.2f}  (1σ)",
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
        {"pose": pose, "score": score, "caer_per_ray": caer}
        for pose, score, caer in rows
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
