"""Whole logs with reference poses, read as a user would, and judged by others' poses."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from thesis.report import number

from fsmsm_jax import OccupancyGrid, ScanAtlas, build_atlas, load_map
from fsmsm_jax.io import ScanLog, read_scans
from fsmsm_jax.localisation.track import Track
from fsmsm_jax.sensing import moments

CARMEN = ("intel", "freiburg-079", "csail")
WEAN = ("cmu_wean_log1", "cmu_wean_log2")
MAC, MAEBOT = "mac_turtlebot4_take2", "maebot_convex"
_RIGHT = 0.5, np.deg2rad(10)  # [m], [rad]: nearer to the reference is not lost


class Recording(NamedTuple):
    """A log, its map, and where others say that the lidar was."""

    name: str
    world: OccupancyGrid
    log: ScanLog
    reference: np.ndarray
    """(scans, 3) poses of the lidar in the map [m, m, rad]; NaN where not known."""
    scored: np.ndarray
    """Indices of the scans that are judged: not those that built the map."""

    def atlas(self) -> ScanAtlas:
        return build_atlas(self.world)

    def moments(self) -> np.ndarray | None:
        """For the compensation of motion, where the log has times of its rays."""
        if self.log.ray_times is None or self.log.stamps is None:
            return None
        return moments(self.log.stamps, self.log.ray_times)

    def upto(self, scans: int) -> "Recording":
        """Its beginning only."""
        kept = self.scored[self.scored < scans]
        return self._replace(reference=self.reference[:scans], scored=kept)

    def errors(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances [m] and angles [rad] from the reference, where judged."""
        rows = self.scored[self.scored < len(poses)]
        off = poses[rows] - self.reference[rows]
        turn = np.abs(np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi)
        return np.hypot(off[:, 0], off[:, 1]), turn


def load(data: Path, name: str) -> Recording:
    """One of the recordings in the folder of data."""
    return _READERS[name](data / "real", name)


def _mac(real, name):
    arrays = np.load(real / f"{name}.npz")
    world = load_map(real / "mac_1st_floor_9_23.yaml")
    reference = arrays["pseudo_gt_laser_9_23"]
    every = np.arange(len(reference))
    return Recording(name, world, read_scans(real / f"{name}.npz"), reference, every)


def _carmen(real, name):
    arrays = np.load(real / f"{name}_dense.npz")
    log = read_scans(real / f"{name}_dense.npz")
    anchors = arrays["gt_anchor_index"]
    reference = np.full((len(log), 3), np.nan)
    reference[anchors] = arrays["gt_anchor_pose"]
    scored = anchors[~arrays["in_map"][anchors]]
    return Recording(name, load_map(real / f"{name}.yaml"), log, reference, scored)


def _wean(real, name):
    arrays = np.load(real / f"{name}.npz")
    reference = arrays["pseudo_gt_laser"]
    log, every = read_scans(real / f"{name}.npz"), np.arange(len(reference))
    return Recording(name, load_map(real / "cmu_wean.yaml"), log, reference, every)


def _maebot(real, name):
    arrays = np.load(real / f"{name}.npz")
    log = read_scans(real / f"{name}.npz")
    scored = np.flatnonzero(arrays["valid"] & ~arrays["in_map"])
    world = load_map(real / f"{name}.yaml")
    return Recording(name, world, log, arrays["scan_end_pose"], scored)


_READERS: dict[str, Callable[[Path, str], Recording]] = {
    MAC: _mac,
    MAEBOT: _maebot,
    **dict.fromkeys(CARMEN, _carmen),
    **dict.fromkeys(WEAN, _wean),
}


def verdict(recording: Recording, track: Track) -> tuple[str, ...]:
    """In words: scans lost by its own word and by ours, and errors."""
    position, turn = recording.errors(track.pose)
    wrong = ~((position < _RIGHT[0]) & (turn < _RIGHT[1]))
    told = track.status[recording.scored[recording.scored < len(track.pose)]] == "lost"
    since = np.flatnonzero(track.status != "lost")
    lost = np.sum(track.status[since[0] :] == "lost") if since.size else len(track.pose)
    centimetres = np.nanpercentile(100 * position, [50, 95, 99])
    return (
        str(int(lost)),
        f"{np.sum(wrong & ~told)} of {len(wrong)}",
        *(number(p) for p in centimetres),
        number(np.rad2deg(np.nanmedian(turn))),
    )
