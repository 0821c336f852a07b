"""Recorded scans: one reader for every kind of log.

A lidar log is a list of turns, each a row of ranges. Whatever the file, the result is
one `ScanLog` of NumPy arrays, still as dirty as the sensor was; `log.scan(i)` turns
row i into a `Scan`, where the dirt is sorted out (see `sensing.lidar`), and
`log.scans()` all rows at once. Odometry, where the log has it, comes along as poses of
the *lidar* at the time of each scan: where the lidar sits on the robot is settled here,
once, and a pose found from a scan is the pose of the lidar, too. Reference poses that a
file may carry are left alone.

- `.npz`: see `io.npz`;
- CARMEN `.log`, `.log.gz`, `.clf`: see `io.carmen`;
- ROS 1 `.bag`, ROS 2 folders, `.db3` and `.mcap`: see `io.rosbag`.

Real logs are torn, out of order and full of holes. What can be read is read, and what
was skipped or mended is counted in `ScanLog.remarks`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from fsmsm_jax.sensing.lidar import Scan

__all__ = ["ScanLog", "read_scans"]

_SUPPORTED = (
    "an .npz with ranges, angle_min and angle_increment (or bearings), a CARMEN log "
    "(.log, .clf, also .gz), a ROS 1 .bag, or a ROS 2 bag (folder, .db3 or .mcap)"
)


@dataclass(frozen=True)
class ScanLog:
    """Scans in the order in which they were recorded; `len(log)` of them."""

    ranges: Float[np.ndarray, "scans rays"]
    """Raw readings [m], no-echo codes and NaN included; NaN pads short scans."""
    bearings: Float[np.ndarray, "scans rays"]
    """Directions in the sensor frame [rad], counter-clockwise."""
    range_min: float
    """Smallest range that counts [m]."""
    range_max: float
    """From this range on a reading means "no echo" [m]."""
    stamps: Float[np.ndarray, "scans"] | None
    """Recording times [s], or None where the file has none; not always increasing."""
    odometry: Float[np.ndarray, "scans 3"] | None = None
    """Pose of the lidar in the odometry's frame at each stamp [m, m, rad]; a row of NaN
    where odometry is missing at that time, None where the log has none at all."""
    ray_times: Float[np.ndarray, "scans rays"] | None = None
    """When each ray was taken, after the scan's stamp [s]; negative where the stamp is
    the last ray's. None if that is not known. See `reversed_sweep`."""
    remarks: tuple[str, ...] = ()
    """What was skipped or mended while reading, in sentences for the user."""

    def __len__(self) -> int:
        return len(self.ranges)

    def scan(self, index: int) -> Scan:
        """The scan at `index`, counted from 0, or from the end if negative.

        Raises:
            ValueError: the log has no such scan, or it holds no information.
        """
        self._check(np.array([index]))
        try:
            return Scan.from_bearings(
                self.ranges[index], self.bearings[index], self.range_min, self.range_max
            )
        except ValueError as error:
            raise ValueError(f"scan {index} of the log: {error}") from error

    def scans(
        self, indices: Int[np.ndarray, "some"] | Sequence[int] | None = None
    ) -> Scan:
        """Many scans along a leading axis, for `vmap` and `lax.scan`.

        Rows are as `scan` gives them, but a scan without information is no error: all
        its rays are invalid.

        Args:
            indices: which scans, counted as in `scan`; None means all.

        Raises:
            ValueError: the log has no such scan.
        """
        rows = np.arange(len(self)) if indices is None else np.asarray(indices)
        self._check(rows)
        shape = (len(rows), self.ranges.shape[1])
        # One long scan obeys the same rules, given one ray that surely says something.
        flat = Scan.from_bearings(
            np.append(self.ranges[rows], self.range_max),
            np.append(self.bearings[rows], 0.0),
            self.range_min,
            self.range_max,
        )
        unfold = lambda leaf: leaf[:-1].reshape(shape)
        return jax.vmap(Scan, (0, 0, 0, 0, None), 0)(
            unfold(flat.ranges),
            unfold(flat.bearings),
            unfold(flat.valid),
            unfold(flat.echo),
            flat.range_max,
        )

    def reversed_sweep(self) -> "ScanLog":
        """The same log, the last ray of each scan being taken first.

        Drivers of RPLidars, which turn clockwise, list the rays counter-clockwise and
        leave the time from ray to ray positive. Nothing in a log tells; compensating
        the motion in a turn with times of the wrong order makes scans worse than they
        were (the recording mac_turtlebot4_take2 is such a log).

        Raises:
            ValueError: the log has no `ray_times`.
        """
        if self.ray_times is None:
            raise ValueError("the log has no times of rays that could be reversed")
        ends = self.ray_times.min(axis=1) + self.ray_times.max(axis=1)
        return replace(self, ray_times=ends[:, None] - self.ray_times)

    def _check(self, indices: np.ndarray) -> None:
        wrong = indices[(indices < -len(self)) | (indices >= len(self))]
        if wrong.size:
            raise ValueError(
                f"the log holds scans 0 to {len(self) - 1}, there is no scan {wrong[0]}"
            )


def read_scans(
    path: str | Path, topic: str | None = None, odometry_topic: str | None = None
) -> ScanLog:
    """All scans of a log file, whatever its format.

    Args:
        path: the log; the module's docstring lists the formats.
        topic: which `LaserScan` topic of a rosbag to read; needed only where it has
            several.
        odometry_topic: which `Odometry` topic of a rosbag to believe; without it, the
            one whose name ends in `odom`, if there are several.

    Raises:
        ValueError: the file is missing, of no supported format, or holds no scans that
            can be read; a rosbag has several scan topics and `topic` names none of
            them, or lacks `odometry_topic`.
        ImportError: the log is a rosbag and the `rosbags` package is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"there is no log at {path}")
    log = _read(path, topic, odometry_topic)
    return replace(log, remarks=(*log.remarks, *_remarks(log)))


def _read(path: Path, topic: str | None, odometry_topic: str | None) -> ScanLog:
    kind = path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix
    if path.is_dir() or kind in (".bag", ".db3", ".mcap"):
        from fsmsm_jax.io.rosbag import read_rosbag

        return read_rosbag(path, topic, odometry_topic)
    if topic is not None or odometry_topic is not None:
        raise ValueError(
            f"only rosbags have topics, {path.name} is none; drop the topic"
        )
    if kind == ".npz":
        from fsmsm_jax.io.npz import read_npz

        return read_npz(path)
    if kind in (".log", ".clf"):
        from fsmsm_jax.io.carmen import read_carmen

        return read_carmen(path)
    raise ValueError(f"cannot read {path.name}: expected {_SUPPORTED}")


def _remarks(log: ScanLog) -> list[str]:
    """What is odd about the times and the odometry of any log."""
    remarks = []
    if log.stamps is not None:
        steps = np.diff(log.stamps)
        if back := np.sum(steps < 0):
            remarks.append(
                f"time goes backwards {back} times, the order of the file is kept"
            )
        if same := np.sum(steps == 0):
            remarks.append(
                f"{same} of {len(log)} scans bear the same time as the one before"
            )
    if log.odometry is not None:
        if missing := np.sum(np.isnan(log.odometry).any(axis=1)):
            remarks.append(
                f"{missing} of {len(log)} scans have no odometry at their time"
            )
    return remarks
