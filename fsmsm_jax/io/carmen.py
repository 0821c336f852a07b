"""CARMEN logs: the text files in which the classic indoor data sets are kept.

Each line is one message. `FLASER n r_1 … r_n x y θ …` is a turn of the front laser; it
does not say where its rays point nor how far the sensor sees. Both follow from custom,
settled by the entropy of the maps that 13 logs give: 181 or 361 rays span −90° to +90°
inclusive, 180 or 360 rays point at −90° + i·180°/n. Newer logs hold `ROBOTLASER1` or
`RAWLASER1` lines instead, which state start angle, step and largest range.

Sensors report "no echo" as a code: 8.19 m (a SICK LMS counting millimetres), 50.0 or
51.2 m, and 81.83 to 81.91 m (counting centimetres). The parameters in a log are no
guide to which (one of them says 50 and reads 81.91), but the readings are: a code is
what many rays read and hardly any ray exceeds.
"""

import gzip
import zlib
from pathlib import Path

import numpy as np

from fsmsm_jax.io.logs import ScanLog

__all__ = ["read_carmen"]

_MESSAGES = ("FLASER", "ROBOTLASER1", "RAWLASER1")  # the same turn, best known first
_FLASER_RAYS = (180, 181, 360, 361)
# (no echo from here on, lowest and highest reading of the code) [m]
_NO_ECHO_CODES = (
    (8.18, 8.18, 8.2),
    (50.0, 49.995, 50.005),
    (50.0, 51.195, 51.205),
    (80.0, 81.8, np.inf),
)
_FARTHEST = 80.0  # [m]: what a SICK LMS measures at most, where no code is found


def read_carmen(path: Path) -> ScanLog:
    """All turns of the front laser in a CARMEN log, `.gz` or plain.

    Raises:
        ValueError: the file is empty, truncated, in another format (CMU's `L` and `O`
            lines among them), or its scans have no known or no common ray count.
    """
    rows = {name: [] for name in _MESSAGES}
    words = set()
    for number, line in enumerate(_lines(path), start=1):
        word, *fields = line.split() or ["#"]
        words.add(word)
        if word in rows:
            rows[word].append((number, fields))
    message = next((name for name in _MESSAGES if rows[name]), None)
    if message is None:
        raise ValueError(
            f"{path.name} holds no scans: expected CARMEN lines that begin with "
            f"{', '.join(_MESSAGES)}, found {sorted(words - {'#'})[:6] or 'nothing'}"
        )
    parse = _flaser if message == "FLASER" else _self_describing
    turns = []
    for number, fields in rows[message]:
        try:
            turns.append(parse(fields))
        except (ValueError, IndexError) as error:
            raise ValueError(
                f"{path.name}, line {number}, {message}: {error}"
            ) from error
    counts = sorted({len(ranges) for ranges, *_ in turns})
    if len(counts) > 1:
        raise ValueError(f"{path.name} mixes scans of {counts} rays; split the log")
    ranges, bearings, stated_max, stamps = map(np.array, zip(*turns, strict=True))
    return ScanLog(
        ranges=ranges,
        bearings=bearings,
        range_min=0.0,
        range_max=min(_no_echo_limit(ranges), float(stated_max.max())),
        stamps=stamps,
    )


def _lines(path: Path) -> list[str]:
    try:
        raw = (
            gzip.decompress(path.read_bytes())
            if path.suffix == ".gz"
            else path.read_bytes()
        )
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path.name} is torn or no gzip file: {error}") from error
    return raw.decode(errors="replace").splitlines()


def _flaser(fields: list[str]) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Ranges, bearings, largest range (unstated) and time of `n r_1 … r_n x y θ …`."""
    rays = int(fields[0])
    if rays not in _FLASER_RAYS:
        raise ValueError(
            "a FLASER line does not say where its rays point; that is known for "
            f"{_FLASER_RAYS} rays, not {rays}: convert the log to .npz with bearings"
        )
    # x y θ and their odometry, then the time, the host and the logger's time
    if len(fields) < 1 + rays + 7:
        raise ValueError(
            f"announces {rays} readings, a pose and a time but ends after "
            f"{len(fields)} fields; the log is torn, cut this line off"
        )
    ranges = np.array(fields[1 : 1 + rays], float)
    steps = rays - 1 if rays % 2 else rays
    bearings = -np.pi / 2 + np.pi / steps * np.arange(rays)
    return ranges, bearings, np.inf, float(fields[1 + rays + 6])


def _self_describing(fields: list[str]) -> tuple[np.ndarray, np.ndarray, float, float]:
    """The same of `type start fov step max accuracy mode n r_1 … r_n m rem_1 …`."""
    start, step, largest = (float(fields[i]) for i in (1, 3, 4))
    rays = int(fields[7])
    remissions = int(fields[8 + rays])
    rest = fields[9 + rays + remissions :]
    # both messages end in the time, the host and the logger's time
    if rays < 1 or len(rest) < 3:
        raise ValueError(
            f"announces {rays} readings, {remissions} remissions and ends too early; "
            "the log is torn, cut this line off"
        )
    ranges = np.array(fields[8 : 8 + rays], float)
    return ranges, start + step * np.arange(rays), largest, float(rest[-3])


def _no_echo_limit(ranges: np.ndarray) -> float:
    """The range [m] from which a reading means "no echo", judged by the readings."""
    for limit, low, high in _NO_ECHO_CODES:
        hits = np.sum((ranges >= low) & (ranges <= high))
        if hits > np.sum(ranges > high):
            return limit
    return _FARTHEST
