"""Maps as ROS keeps them: a picture beside a YAML file that says what it means.

`map_server` turns each pixel into an occupancy: black is a wall, white is floor,
grey is anybody's guess. How occupied a pixel is, `1 - shade` (or `shade` when
`negate` is set), is compared with two thresholds, and `mode` decides what becomes of
the pixels between them: unknown (trinary), a percentage (scale), or no comparison at
all, the pixel value being the percentage (raw).

The rules are those of nav2's `map_io.cpp`. Three that surprise: the famous grey 205
is unknown by a hair, 50/255 = 0.19608 against a threshold of 0.196; pixels that are
not fully opaque are unknown, while opaque ones mean their colour (older releases
average alpha into the colour, which frees opaque grey); and a PGM whose largest value
is not 255 is stretched until it is, so white is white whatever number stands for it.
"""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from fsmsm_jax.world.occupancy import OccupancyGrid

__all__ = ["load_map", "save_map"]

_KEYS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_MODES = ("trinary", "scale", "raw")
_FORMATS = ("PPM", "PNG", "BMP", "JPEG")  # Pillow's PPM covers PBM, PGM and PPM


def load_map(path: str | os.PathLike, *, unknown: str = "transparent") -> OccupancyGrid:
    """Read a `map_server` map: a YAML file and the image it names.

    PGM (plain or binary, PPM content too), PNG, BMP and JPEG images are read, in grey,
    colour or palette, with or without alpha, in 8 or 16 bits.

    Args:
        path: the YAML file; the image's path in it is absolute or relative to it.
        unknown: "transparent" lets rays through unknown space, "opaque" stops them.

    Returns:
        The grid, its row 0 at the bottom of the image, its origin as in the file.

    Raises:
        ValueError: a file is missing or damaged, an entry of the YAML is missing or
            makes no sense, or no cell of the map is free.

    Example:
        >>> import tempfile
        >>> cells = np.eye(3, dtype=int) * 100
        >>> room = OccupancyGrid.from_cells(cells, 0.1, origin=(1.0, 2.0, 0.5))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_map(room, f"{folder}/room.yaml")
        ...     print(load_map(f"{folder}/room.yaml").cells)
        [[100   0   0]
         [  0 100   0]
         [  0   0 100]]
    """
    path = Path(path).expanduser()
    meta = _read_yaml(path)
    resolution = _number(meta["resolution"], "resolution", path)
    if resolution <= 0:
        raise ValueError(
            f"{path}: resolution must be more than 0 m per pixel, got {resolution}; "
            "write the side of a cell in metres"
        )
    origin = meta["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        raise ValueError(
            f"{path}: origin must be three numbers [x, y, yaw], got {origin!r}; "
            "write a yaw of 0.0 if the map is not turned"
        )
    origin = tuple(_number(value, "origin", path) for value in origin)
    mode = meta.get("mode", "trinary")
    if mode not in _MODES:
        raise ValueError(
            f"{path}: mode must be one of {', '.join(_MODES)}, got {mode!r}"
        )
    if meta["negate"] not in (0, 1):
        raise ValueError(f"{path}: negate must be 0 or 1, got {meta['negate']!r}")
    free = _number(meta["free_thresh"], "free_thresh", path)
    occupied = _number(meta["occupied_thresh"], "occupied_thresh", path)
    if not 0 <= free <= occupied <= 1:
        raise ValueError(
            f"{path}: expected 0 ≤ free_thresh ≤ occupied_thresh ≤ 1, got free_thresh "
            f"{free} and occupied_thresh {occupied}; map_saver writes 0.25 and 0.65"
        )
    if not isinstance(meta["image"], str) or not meta["image"]:
        raise ValueError(
            f"{path}: image must be the path of a picture, got {meta['image']!r}"
        )

    levels, top, opaque = _read_image(path.parent / meta["image"], path)
    cells = _meaning(top, mode, bool(meta["negate"]), free, occupied)[levels]
    if mode != "raw":
        cells = np.where(opaque, cells, np.int8(-1))
    grid = OccupancyGrid.from_cells(
        np.flipud(cells), resolution, origin, unknown=unknown
    )
    if not grid.free.any():
        raise ValueError(
            f"{path}: no cell of the map is free ({(cells < 0).mean():.0%} unknown, "
            "the rest occupied); check the image and the entries negate "
            f"({meta['negate']}), free_thresh ({free}) and mode ({mode})"
        )
    return grid


def save_map(grid: OccupancyGrid, path: str | os.PathLike) -> None:
    """Write a grid as a `map_server` map that `load_map` reads back exactly.

    A grid of free (0), occupied (100) and unknown (−1) cells becomes the usual picture
    of white, black and grey; one that holds other percentages is written in mode raw.

    Args:
        grid: the map.
        path: the YAML file to write; the PGM image goes beside it, of the same name.

    Raises:
        ValueError: the path does not end in .yaml or .yml, or cannot be written.

    Note:
        The format cannot say whether unknown space stops rays: say it to `load_map`.
    """
    path = Path(path).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(
            f"the path must end in .yaml or .yml, got {path}; the image goes beside"
        )
    height, width = grid.extent
    cells = np.flipud(np.asarray(grid.cells)[:height, :width])
    if np.isin(cells, (-1, 0, 100)).all():
        mode, pixels = "trinary", np.where(cells < 0, 205, np.where(cells == 0, 254, 0))
    else:
        mode, pixels = "raw", np.where(cells < 0, 255, cells)
    *origin, resolution = (
        np.format_float_positional(
            value, trim="0"
        )  # the shortest that reads back equal
        for value in np.append(grid.origin, grid.resolution)
    )
    image = path.with_suffix(".pgm")
    text = yaml.safe_dump(
        {"image": image.name, "mode": mode}, allow_unicode=True, sort_keys=False
    )
    text += (
        f"resolution: {resolution}\norigin: [{', '.join(origin)}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    try:
        Image.fromarray(pixels.astype(np.uint8)).save(image)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ValueError(f"cannot write the map to {path}: {error}") from error


def _read_yaml(path: Path) -> dict:
    """The entries of the YAML file, all that are required being there."""
    try:
        meta = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(
            f"cannot read the map file {path}: {error.strerror}; "
            "give the path of a map_server .yaml file"
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(
            f"{path} is not a YAML file ({error}); give the .yaml that names the "
            "image, not the image itself"
        ) from error
    if not isinstance(meta, dict):
        raise ValueError(
            f"{path} must hold `key: value` lines such as `resolution: 0.05`"
        )
    missing = [key for key in _KEYS if meta.get(key) is None]
    if missing:
        raise ValueError(
            f"{path} lacks {', '.join(missing)}; a map_server map states "
            f"{', '.join(_KEYS)}"
        )
    return meta


def _number(value: Any, name: str, path: Path) -> float:
    """A finite number; YAML 1.1 hands `5e-2` over as a string, map_server takes it."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(
            f"{path}: {name} must be a finite number, got {value!r}; correct the file"
        )
    return number


def _read_image(image: Path, path: Path) -> tuple[np.ndarray, int, np.ndarray]:
    """The grey level of each pixel, the level of white, and which pixels are opaque.

    The level of a colour pixel is the sum of its channels: their mean, kept whole.
    """
    if not image.is_file():
        raise ValueError(
            f"{path} names the image {image}, which is not there; put it beside the "
            "YAML or correct the `image:` line"
        )
    try:
        with Image.open(image, formats=_FORMATS) as picture:
            if picture.mode.startswith("I"):
                levels = np.asarray(picture, dtype=np.int32)
                return levels, 65535, np.ones(levels.shape, bool)
            alpha = picture.has_transparency_data
            pixels = np.asarray(picture.convert("RGBA" if alpha else "RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(
            f"cannot read the image {image}: {error}; it must be a whole PGM, PNG, BMP "
            "or JPEG file, so export it again"
        ) from error
    levels = pixels[..., :3].sum(axis=-1, dtype=np.int32)
    opaque = pixels[..., 3] == 255 if alpha else np.ones(levels.shape, bool)
    return levels, 3 * 255, opaque


def _meaning(
    top: int, mode: str, negate: bool, free: float, occupied: float
) -> np.ndarray:
    """What each grey level from 0 to `top` says of a cell: −1, or per cent occupied.

    An image knows few levels, so a table holds all that the thresholds can answer.
    """
    level = np.arange(top + 1)
    if mode == "raw":
        value = np.rint(255 * level / top)
        return np.where(value <= 100, value, -1).astype(np.int8)
    # Subtract before dividing: 51/255 equals a threshold of 0.2, 1 − 204/255 does not.
    occupancy = (level if negate else top - level) / top
    percent = np.rint(np.interp(occupancy, (free, occupied), (0, 100)))
    if mode == "trinary":
        percent[(occupancy >= free) & (occupancy <= occupied)] = -1
    return percent.astype(np.int8)
