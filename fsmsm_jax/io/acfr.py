"""The ACFR's utility car: the car park and Victoria Park, Sydney.

A pick-up whose rear left wheel counts the way and whose lidar (a SICK, 180°, 4.7 turns
a second) sits on the front bumper, half a metre left of the middle. In the car park,
the poles that are to be found carry reflecting tape, and the lidar says of each ray
whether it came back bright: bright rays closer than four to each other are one pole, at
their median range and mean bearing. In Victoria Park trees are the landmarks, and the
file holds them found already: range and bearing of their middles.

The lidar's beams are counted from its right, so bearings are less a quarter turn. The
state is the lidar's pose. The GPS antenna stands above the lidar: fitted to dead
reckoning it comes out within 2 cm of it in the car park, 4 cm in Victoria Park. So
fixes need no lever arm.

The steering reads 0.006 rad too far right and 2 % too little in the car park, 0.004 to
0.007 rad and 4 % in Victoria Park, and the lidar's times are 0.05 s late against the
wheel's; the log is left as it is. With the steering mended, dead reckoning ends half a
metre from GPS instead of eight after 175 m (car park), and 40 m instead of 200 m after
4 km.

Reference: J. Nieto, J. Guivant, E. Nebot, S. Thrun, "Real time data association for
FastSLAM", ICRA 2003; J. Guivant, E. Nebot, IEEE T-RA 17(3), 2001.
"""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from fsmsm_jax.io.landmarks import LandmarkLog, cut_at_looks
from fsmsm_jax.io.tables import read_mat, read_table
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Car

__all__ = ["bright_poles", "read_carpark", "read_victoria_park"]

_TRACKED = (3.78, 0.5)  # [m]: the lidar, forward and left of the rear axle's middle
_CARPARK_NOISE = (0.7, math.radians(7.0))
_CARPARK_SENSOR = RangeBearing((0.1, math.radians(1.0)), 11.0)  # 95 % of detections
_CARPARK_SECONDS = 112.0  # after that the car leaves the poles
_CARPARK_HEADING = math.radians(-128.0)
_PARK_NOISE = (0.5, 0.1)
_PARK_SENSOR = RangeBearing((0.3, 0.02), 35.0, math.pi / 2 - 5 * math.pi / 306)
_PARK_START = np.array([-67.6493, -41.7142, math.radians(35.5)])
_TOLD_BY = "detections_with_beacon_id.csv"
_SAME_BEARING = 1e-3  # [rad]: the tables are rounded to 1e-4, beams are 9e-3 apart
_NEAREST_POLE, _FARTHEST_POLE = 1.0, 30.0  # [m]


def read_carpark(folder: str | Path, until: float = _CARPARK_SECONDS) -> LandmarkLog:
    """The car park: data_set.mat, or the tables odometry, detections and gps (.csv).

    Which pole each detection is, is not in the log; detections_with_beacon_id.csv says
    it where it is there. Without data_set.mat, looks that found nothing are not known
    and their steps are missing.

    Args:
        folder: with data_set.mat and beac_juan3.mat, or odometry.csv, gps.csv,
            detections.csv and beacons_gps_surveyed.csv.
        until: how much of it [s]; the poles are near for 112 s.

    Returns:
        The log; time 0 is the first message. It starts where GPS was at the first look,
        heading −128° (fitted to what followed: −127° to −129°). Noise is the ACFR's
        own; steering of 7° is no exaggeration, for its heading errors grow by 0.02 rad
        in a second, and 0.05 rad, 40 times a second, would make it 0.005.

    Raises:
        ValueError: files are missing, torn or do not fit.
    """
    folder = Path(folder)
    if (folder / "data_set.mat").is_file():
        controls, fixes, looks, found = _carpark_recording(folder / "data_set.mat")
    else:
        controls = read_table(folder / "odometry.csv", 3)
        fixes = read_table(folder / "gps.csv", 3)
        told = (folder / _TOLD_BY).is_file()
        table = read_table(folder / (_TOLD_BY if told else "detections.csv"), 4)
        looks, numbers = np.unique(table[:, 0], return_inverse=True)
        found = np.column_stack([numbers, table[:, 2:4]])
    ids = _pole_ids(folder / _TOLD_BY, looks, found)

    kept = looks < until
    wanted = kept[found[:, 0].astype(int)]
    found = found[wanted]
    found[:, 0] = (np.cumsum(kept) - 1)[found[:, 0].astype(int)]
    drive, times, remarks = cut_at_looks(controls, looks[kept], found, ids[wanted])
    fixes = _usable_fixes(fixes, times[-1])
    if len(fixes) == 0:
        raise ValueError(f"{folder} has no GPS fix before {times[-1]:.1f} s")
    at = [np.interp(times[0], fixes[:, 0], fixes[:, i]) for i in (1, 2)]
    return LandmarkLog(
        drive,
        times,
        np.array([*at, _CARPARK_HEADING]),
        _car(_CARPARK_NOISE),
        _CARPARK_SENSOR,
        fixes,
        landmarks=_beacons(folder),
        remarks=remarks,
    )


def _carpark_recording(
    path: Path,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Controls, fixes, times of looks, and poles found, of the original file."""
    names = ("Time_VS", "Velocity", "Steering", "TimeGPS", "GPSLon", "GPSLat")
    data = read_mat(path, (*names, "TimeLaser", "Laser", "Intensity"))
    stacks = []
    for group in (names[:3], names[3:]):
        rows = [data[name].ravel().astype(float) for name in group]
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"{group} of {path.name} are not of one length")
        stacks.append(np.column_stack(rows))
    controls, fixes = stacks
    looks = data["TimeLaser"].ravel().astype(float)
    ranges, brightness = data["Laser"], data["Intensity"]
    if ranges.shape != brightness.shape or len(ranges) != len(looks):
        raise ValueError(
            f"Laser, Intensity and TimeLaser of {path.name} do not fit: "
            f"{ranges.shape}, {brightness.shape}, {looks.shape}"
        )
    zero = min(np.nanmin(t) for t in (controls[:, 0], fixes[:, 0], looks))
    controls[:, 0] -= zero
    fixes[:, 0] -= zero
    return controls, fixes, looks - zero, bright_poles(ranges, brightness)


def bright_poles(
    ranges: Shaped[np.ndarray, "scans rays"],
    brightness: Shaped[np.ndarray, "scans rays"],
) -> Float[np.ndarray, "poles 3"]:
    """Reflecting poles in scans over 180°, from the right to the left.

    Args:
        ranges: [m].
        brightness: zero where the ray came back no brighter than from a wall.

    Returns:
        Scan, range [m] and bearing [rad] of each pole.

    Example:
        >>> ranges, bright = np.full((1, 181), 9.0), np.zeros((1, 181))
        >>> bright[0, [90, 92]] = 1
        >>> bright_poles(ranges, bright).round(4)
        array([[0.    , 9.    , 0.0175]])
    """
    near = (ranges > _NEAREST_POLE) & (ranges < _FARTHEST_POLE)
    scan, ray = np.nonzero(near & (brightness > 0))
    new = (np.diff(scan) > 0) | (np.diff(ray) > 3)
    groups = np.split(np.arange(len(scan)), np.flatnonzero(new) + 1)
    step = np.pi / (ranges.shape[1] - 1)
    poles = [
        (scan[g[0]], np.median(ranges[scan[g], ray[g]]), ray[g].mean() * step)
        for g in groups
        if len(g)
    ]
    return np.array(poles, float).reshape(-1, 3) - [0.0, 0.0, np.pi / 2]


def _pole_ids(path: Path, looks: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Which surveyed pole each detection is, −1 where the table does not say."""
    ids = np.full(len(found), -1)
    if not path.is_file():
        return ids
    table = read_table(path, 6)
    stamps = looks[found[:, 0].astype(int)]
    same = (np.abs(stamps[:, None] - table[None, :, 0]) < _SAME_BEARING) & (
        np.abs(found[:, 2, None] - table[None, :, 3]) < _SAME_BEARING
    )
    told = same.any(axis=1)
    numbers = np.nan_to_num(np.maximum(table[:, 5], -1), nan=-1).astype(int)
    ids[told] = numbers[same[told].argmax(axis=1)]
    return ids


def _beacons(folder: Path) -> Float[np.ndarray, "poles 2"] | None:
    """The poles' surveyed places [m], if there is a survey."""
    if (folder / "beac_juan3.mat").is_file():
        return read_mat(folder / "beac_juan3.mat", ["estbeac"])["estbeac"].astype(float)
    if (folder / "beacons_gps_surveyed.csv").is_file():
        return read_table(folder / "beacons_gps_surveyed.csv", 2)
    return None


def read_victoria_park(folder: str | Path, until: float = np.inf) -> LandmarkLog:
    """Victoria Park: 26 minutes and 4 km among trees.

    Args:
        folder: with VictoriaParkSinSincronizar.mat (controls, looks, trees) and, if
            there, aa3_gpsx.mat.
        until: how much of it, by the log's clock [s]; it begins at 22 s.

    Returns:
        The log; its start is where GPS begins, heading 35.5° as customary. GPS is
        patchy: it covers 880 of 1 550 s, and 90 fixes jump by metres, some by 140 m.
        Compare with medians. Nobody published
        noise. Measured look against look within 10 s: range 0.08 m, bearing 0.006 rad,
        here doubled, as trees look different from behind; way 0.03 m and heading
        0.006 rad in a second, once the steering is mended. Of what is found farther
        than 40 m, less than a third is found again a second later.

    Raises:
        ValueError: files are missing, torn or do not fit.
    """
    folder = Path(folder)
    path = folder / "VictoriaParkSinSincronizar.mat"
    data = read_mat(path, ["time", "u", "TLsr", "zt"])
    stamps, moves = data["time"].ravel(), data["u"]
    looks, cells = data["TLsr"].ravel().astype(float), data["zt"].ravel()
    if moves.shape != (2, len(stamps)) or len(cells) != len(looks):
        raise ValueError(
            f"expected u of shape (2, {len(stamps)}) and {len(looks)} cells zt in "
            f"{path.name}, got {moves.shape} and {len(cells)}"
        )
    kept = np.flatnonzero(looks < until)
    if len(kept) == 0:
        raise ValueError(f"{path.name} holds no look before {until} s")
    found = _trees([cells[i] for i in kept], path)
    controls = np.column_stack([stamps, moves.T]).astype(float)
    drive, times, remarks = cut_at_looks(controls, looks[kept], found)
    fixes = np.zeros((0, 3))
    if (folder / "aa3_gpsx.mat").is_file():
        gps = read_mat(folder / "aa3_gpsx.mat", ["timeGps", "Lo_m", "La_m"])
        stamps, *places = (gps[name].ravel() for name in ("timeGps", "Lo_m", "La_m"))
        fixes = _usable_fixes(np.column_stack([stamps / 1e3, *places]), times[-1])
    car = _car(_PARK_NOISE)
    return LandmarkLog(
        drive, times, _PARK_START, car, _PARK_SENSOR, fixes, remarks=remarks
    )


def _trees(cells: list[np.ndarray], path: Path) -> Float[np.ndarray, "trees 3"]:
    """Look, range [m] and bearing [rad] of each tree; its diameter is left alone."""
    rows = []
    for look, cell in enumerate(cells):
        if cell.size == 0:
            continue
        if cell.ndim != 2 or len(cell) < 2:
            raise ValueError(
                f"look {look} of {path.name} should hold ranges, bearings and "
                f"diameters, 3 rows; its shape is {cell.shape}"
            )
        number = np.full(cell.shape[1], look)
        rows.append(np.column_stack([number, cell[0], cell[1] - np.pi / 2]))
    return np.concatenate(rows) if rows else np.zeros((0, 3))


def _car(noise: tuple[float, float]) -> Car:
    return Car(wheel_base=2.83, wheel_offset=0.76, tracked=_TRACKED, noise=noise)


def _usable_fixes(
    fixes: Float[np.ndarray, "fixes 3"], last: float
) -> Float[np.ndarray, "usable 3"]:
    """Finite ones up to a time, sorted."""
    fixes = fixes[np.isfinite(fixes).all(axis=1) & (fixes[:, 0] <= last)]
    return fixes[np.argsort(fixes[:, 0], kind="stable")]
