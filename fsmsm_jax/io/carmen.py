"""CARMEN logs: the text files in which the classic indoor data sets are kept.

Each line is one message. `FLASER n r_1 … r_n x y θ x' y' θ' …` is a turn of the front
laser, the robot's odometry being x' y' θ'; it does not say where its rays point nor how
far the sensor sees. Both follow from custom, settled by the entropy of the maps that 13
logs give: 181 or 361 rays span −90° to +90° inclusive, 180 or 360 rays point at
−90° + i·180°/n. Newer logs hold `ROBOTLASER1` or `RAWLASER1` lines instead, which state
start angle, step and largest range; the first also the laser's odometry, for the second
it is found between `ODOM` lines. `PARAM robot_frontlaser_offset` is how far the laser
sits ahead of the robot's centre.

Sensors report "no echo" as a code: 8.19 m (a SICK LMS counting millimetres), 50.0 or
51.2 m, and 81.83 to 81.91 m (counting centimetres). The parameters in a log are no
guide to which (one of them says 50 and reads 81.91), but the readings are: a code is
what many rays read and hardly any ray exceeds.

Logs "corrected" by GMapping (they hold `NEFF` lines) have no odometry left in their
scans, both poses are where SLAM put the laser; tracking with them would be cheating.
But the `ODOM` lines between two scans go on by odometry from the corrected pose of the
first, so the motion from scan to scan is still there, and chained it is the odometry of
the recording: on intel and freiburg-079 to 0.1 mm and 0.01 mrad a step.
"""

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fsmsm_jax.io.frames import between, chain, compose, interpolate
from fsmsm_jax.io.layout import stack_rows
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
_MOST_GARBAGE = 0.1  # of the lines with scans: a file with more is no such log
_UNKNOWN = np.full(3, np.nan)


class _Turn(NamedTuple):
    """One scan line: its rays, its time [s], and a pose by odometry [m, m, rad]."""

    ranges: np.ndarray
    first: float
    step: float
    largest: float
    stamp: float
    pose: np.ndarray


class _Odometer(NamedTuple):
    """One `ODOM` line: where in the file, when [s], and the robot's pose."""

    line: int
    stamp: float
    pose: np.ndarray


def read_carmen(path: Path) -> ScanLog:
    """All turns of the front laser in a CARMEN log, `.gz` or plain.

    Lines that make no sense are left out and counted.

    Raises:
        ValueError: the file is empty or in another format (CMU's `L` and `O` lines
            among them); no scan in it can be read, or more than a tenth cannot.
    """
    lines, torn = _lines(path)
    rows = {name: [] for name in (*_MESSAGES, "ODOM", "PARAM")}
    words = set()
    last = 0
    for number, line in enumerate(lines, start=1):
        word, *fields = line.split() or ["#"]
        last = number if line.strip() else last
        words.add(word)
        if word in rows:
            rows[word].append((number, fields))
    message = next((name for name in _MESSAGES if rows[name]), None)
    if message is None:
        raise ValueError(
            f"{path.name} holds no scans: expected CARMEN lines that begin with "
            f"{', '.join(_MESSAGES)}, found {sorted(words - {'#'})[:6] or 'nothing'}"
        )
    numbers, turns, remarks = _parsed(path, message, rows[message], last)
    ranges, bearings, mended = stack_rows(
        [turn.ranges for turn in turns],
        np.array([turn.first for turn in turns]),
        np.array([turn.step for turn in turns]),
    )
    stamps = np.array([turn.stamp for turn in turns])
    odometer = _odometer_lines(rows["ODOM"])
    poses = np.array([turn.pose for turn in turns])
    poses = np.where(np.isfinite(poses).all(axis=1, keepdims=True), poses, np.nan)
    said = ()
    if "NEFF" in words:
        poses, said = _uncorrected(poses, numbers, odometer)
    elif message == "FLASER":
        poses = compose(poses, _mounting(rows["PARAM"]))
    elif message == "RAWLASER1" and odometer:
        _, times, known = zip(*odometer, strict=True)
        poses = interpolate(stamps, np.array(times), np.array(known))
        poses = compose(poses, _mounting(rows["PARAM"]))
    elif message == "RAWLASER1":
        poses = None
    return ScanLog(
        ranges=ranges,
        bearings=bearings,
        range_min=0.0,
        range_max=min(_no_echo_limit(ranges), max(turn.largest for turn in turns)),
        stamps=stamps,
        odometry=poses,
        remarks=(*torn, *remarks, *mended, *said),
    )


def _lines(path: Path) -> tuple[list[str], tuple[str, ...]]:
    """The lines of a file, as many as can be unpacked, and whether that was not all."""
    pieces, torn = [], ()
    if path.suffix == ".gz":
        try:
            with gzip.open(path) as file:
                while piece := file.read1(1 << 16):
                    pieces.append(piece)
        except (OSError, EOFError, zlib.error) as error:
            if not pieces:
                raise ValueError(f"{path.name} is torn or no gzip file: {error}") from (
                    error
                )
            torn = (f"{path.name} is torn, {error}: what could be unpacked was read",)
    else:
        pieces.append(path.read_bytes())
    return b"".join(pieces).decode(errors="replace").splitlines(), torn


def _parsed(
    path: Path, message: str, rows: list, last: int
) -> tuple[list[int], list[_Turn], list[str]]:
    """Line numbers and contents of the scans that make sense, and what did not."""
    parse = {"FLASER": _flaser, "ROBOTLASER1": _robotlaser, "RAWLASER1": _rawlaser}
    numbers, turns, bad = [], [], []
    for number, fields in rows:
        try:
            turns.append(parse[message](fields))
            numbers.append(number)
        except (ValueError, IndexError) as error:
            bad.append((number, f"{path.name}, line {number}, {message}: {error}"))
    remarks = []
    if turns and bad and bad[-1][0] == last:
        number, _ = bad.pop()
        remarks.append(
            f"the log breaks off in line {number}: {len(turns)} scans were read"
        )
    if not turns or len(bad) > _MOST_GARBAGE * len(rows):
        raise ValueError(
            f"{bad[0][1]}; {len(bad)} of {len(rows)} lines with scans make no sense"
        )
    if bad:
        remarks.append(
            f"{len(bad)} of {len(rows)} lines with scans make no sense and were left "
            f"out; {bad[0][1]}"
        )
    return numbers, turns, remarks


def _flaser(fields: Sequence[str]) -> _Turn:
    """The scan and robot's pose of `n r_1 … r_n x y θ x' y' θ' time host time`."""
    rays = int(fields[0])
    if rays not in _FLASER_RAYS:
        raise ValueError(
            "a FLASER line does not say where its rays point; that is known for "
            f"{_FLASER_RAYS} rays, not {rays}: convert the log to .npz with bearings"
        )
    rest = fields[1 + rays :]
    if len(rest) < 8:  # the time might be torn, were it the last
        raise ValueError(
            f"announces {rays} readings, two poses and a time but ends after "
            f"{len(fields)} fields; the log is torn"
        )
    return _Turn(
        ranges=np.array(fields[1 : 1 + rays], float),
        first=-np.pi / 2,
        step=np.pi / (rays - 1 if rays % 2 else rays),
        largest=np.inf,
        stamp=_finite(rest[6]),
        pose=np.array(rest[3:6], float),
    )


def _robotlaser(fields: Sequence[str]) -> _Turn:
    """The scan and the laser's pose of a `ROBOTLASER1` line.

    After the remissions come the poses of laser and robot, two speeds, three distances,
    the time, the host and the logger's time.
    """
    turn, rest = _self_describing(fields, 14)
    return turn._replace(pose=np.array(rest[:3], float))


def _rawlaser(fields: Sequence[str]) -> _Turn:
    """The scan of a `RAWLASER1` line, which ends in time, host and logger's time."""
    return _self_describing(fields, 3)[0]


def _self_describing(fields: Sequence[str], after: int) -> tuple[_Turn, Sequence[str]]:
    """The scan of `type start fov step max accuracy mode n r_1 … r_n m rem_1 …`.

    `after` fields follow, of which the third but last is the time; they are returned.
    """
    start, step, largest = (_finite(fields[i]) for i in (1, 3, 4))
    rays = int(fields[7])
    remissions = int(fields[8 + rays])
    rest = fields[9 + rays + remissions :]
    if rays < 1 or len(rest) < after:
        raise ValueError(
            f"announces {rays} readings, {remissions} remissions and ends too early; "
            "the log is torn"
        )
    ranges = np.array(fields[8 : 8 + rays], float)
    return _Turn(ranges, start, step, largest, _finite(rest[after - 3]), _UNKNOWN), rest


def _finite(field: str) -> float:
    if not np.isfinite(number := float(field)):
        raise ValueError(f"expected a finite number, found {field}")
    return number


def _odometer_lines(rows: list) -> list[_Odometer]:
    """What `x y θ speed turn acceleration time …` lines say, torn ones left out."""
    found = []
    for line, fields in rows:
        try:
            pose = np.array(fields[:3], float)
            found.append(_Odometer(line, float(fields[6]), pose))
        except (ValueError, IndexError):
            continue
    return found


def _mounting(rows: list) -> np.ndarray:
    """Pose of the laser in the robot [m, m, rad]."""
    for _, (name, *values) in (row for row in rows if row[1]):
        if name == "robot_frontlaser_offset" and values:
            return np.array([float(values[0]), 0.0, 0.0])
    return np.zeros(3)


def _uncorrected(
    corrected: np.ndarray, numbers: list[int], odometer: list[_Odometer]
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """The laser's odometry chained from the motions that GMapping left between scans.

    After each scan GMapping repeats its corrected pose in an `ODOM` line with time 0;
    the lines from there to the next scan continue by odometry.
    """
    said = "the poses in this log were corrected by SLAM (NEFF lines)"
    raw = [one for one in odometer if one.stamp != 0]
    before = np.searchsorted([one.line for one in raw], numbers[1:]) - 1
    gaps = [b < 0 or raw[b].line < n for b, n in zip(before, numbers[:-1], strict=True)]
    if any(gaps) or np.isnan(corrected).any():
        return None, (
            f"{said} and its ODOM lines do not bridge all scans: no odometry",
        )
    arrived = np.array([raw[b].pose for b in before]).reshape(-1, 3)
    motions = between(corrected[:-1], arrived)
    return chain(corrected[0], motions), (
        f"{said}; odometry was chained from the ODOM lines between the scans",
    )


def _no_echo_limit(ranges: np.ndarray) -> float:
    """The range [m] from which a reading means "no echo", judged by the readings."""
    for limit, low, high in _NO_ECHO_CODES:
        hits = np.sum((ranges >= low) & (ranges <= high))
        if hits > np.sum(ranges > high):
            return limit
    return _FARTHEST
