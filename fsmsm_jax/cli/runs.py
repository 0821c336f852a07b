"""A run through a log, and the folder that keeps it.

What is known is on the disk: each fix is written as soon as it is computed, and when
the log breaks off or somebody presses Ctrl-C, metrics and picture of what there was
follow. The folder holds all that it takes to look at a run a year later:

    config.json      settings, versions, commit, map, log, and what was odd about it
    trajectory.tum   time and pose, a line a scan; not those at which it was lost
    fixes.csv        every scan: pose, σ, status, and how well the map explains it
    metrics.json     shares, times of a step, distance
    track.png        the way on the map
"""

import csv
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from json import dumps
from pathlib import Path
from types import TracebackType
from typing import get_args

import jax
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from fsmsm_jax.io.logs import ScanLog
from fsmsm_jax.io.tum import TumWriter
from fsmsm_jax.localisation.follow import Fix
from fsmsm_jax.localisation.track import Track

__all__ = [
    "Run",
    "circumstances",
    "new_folder",
    "picture_path",
    "scan_times",
    "write_json",
]

_LEG = 0.1  # [m]: shorter ways are noise and do not add to the distance driven
_STATUSES = get_args(Fix.__annotations__["status"])
_COLUMNS = (
    *("scan", "time_s", "status", "x_m", "y_m", "heading_rad"),
    *("sigma_x_m", "sigma_y_m", "sigma_heading_rad"),
    *("caer_per_ray_m", "explained", "doubt", "step_ms"),
)
_PACKAGES = ("fsmsm-jax", "jax", "jaxlib", "numpy", "scipy", "equinox", "rosbags")


class Run:
    """One pass through a log: what came out, and the files that it goes to at once.

    A context manager, which closes the files.

    Args:
        stamps: time of each scan [s]; a scan without a finite one is not written to
            the trajectory.
        tum: the trajectory's file, if it is wanted.
        folder: of the run, if it is wanted; it exists.
    """

    def __init__(
        self,
        stamps: Float[np.ndarray, "scans"],
        tum: Path | None = None,
        folder: Path | None = None,
    ):
        self.fixes: list[Fix] = []
        """What came out so far."""
        self._stamps = stamps
        self._seconds, self._compiled = [], []
        self._files, self._trajectories, self._table = ExitStack(), [], None
        with ExitStack() as opening:
            for path in (tum, folder and folder / "trajectory.tum"):
                if path is not None:
                    writer = opening.enter_context(TumWriter(path))
                    self._trajectories.append(writer)
            if folder is not None:
                table = (folder / "fixes.csv").open("w", encoding="utf-8", newline="")
                self._table = opening.enter_context(table)
                csv.writer(self._table).writerow(_COLUMNS)
            self._files = opening.pop_all()

    def __enter__(self) -> "Run":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.close()

    def record(self, fixes: Iterable[Fix]) -> None:
        """Take fixes to their end, or to whatever stops them; with a bar on stderr."""
        fixes = iter(fixes)
        with (
            tqdm(total=len(self._stamps), unit="scan", desc="track") as bar,
            _compilations() as compilations,
        ):
            while True:
                begun, before = time.perf_counter(), compilations()
                fix = next(fixes, None)
                if fix is None:
                    return
                self._seconds.append(time.perf_counter() - begun)
                self._compiled.append(compilations() > before)
                self.fixes.append(fix)
                self._write(len(self.fixes) - 1, fix)
                bar.set_postfix_str(fix.status, refresh=False)
                bar.update()

    def _write(self, index: int, fix: Fix) -> None:
        """To the files, and through to the disk."""
        stamp = self._stamps[index]
        if fix.status != "lost" and np.isfinite(stamp):
            for trajectory in self._trajectories:
                trajectory.write(stamp, fix.pose)
        if self._table is None:
            return
        place = [f"{number:.6f}" for number in fix.pose]
        sigma = np.sqrt(np.diagonal(fix.covariance))
        judged = (fix.caer_per_ray, fix.explained, fix.doubt, 1e3 * self._seconds[-1])
        numbers = [f"{number:.6g}" for number in (*sigma, *judged)]
        row = [index, f"{stamp:.9f}", fix.status, *place, *numbers]
        csv.writer(self._table).writerow(row)
        self._table.flush()

    def track(self) -> Track:
        """What came out so far, stacked; at least one fix."""
        columns = zip(*self.fixes, strict=True)
        return Track(*(np.stack([np.asarray(part) for part in f]) for f in columns))

    def metrics(self) -> dict:
        """The run in numbers, for JSON.

        Returns:
            `scans` of the log and how many were `computed`; `count` and `share` of each
            status; scans at which it was found (`localised_at`), how often it got lost
            after that (`times_lost`); times of a step without those that waited for a
            program to be compiled or loaded, which are counted apart; `distance_m`
            driven; the last known pose [m, m, rad] with its σ.
        """
        statuses = np.array([fix.status for fix in self.fixes], str)
        count = {name: int(np.sum(statuses == name)) for name in _STATUSES}
        lost = statuses == "lost"
        seconds, compiled = np.array(self._seconds), np.array(self._compiled, bool)
        warm = 1e3 * seconds[~compiled]
        quantile = lambda q: float(np.quantile(warm, q)) if warm.size else None
        return {
            "scans": len(self._stamps),
            "computed": len(statuses),
            "count": count,
            "share": {name: n / max(len(statuses), 1) for name, n in count.items()},
            "localised_at": np.flatnonzero(statuses == "localised").tolist(),
            "times_lost": int(np.sum(lost[1:] & ~lost[:-1])),
            "step_ms": {"median": quantile(0.5), "p99": quantile(0.99)},
            "compiling": {
                "scans": int(compiled.sum()),
                "seconds": float(seconds[compiled].sum()),
            },
            "seconds": float(seconds.sum()),
            "distance_m": _distance(self.fixes),
            "last": _last(self.fixes),
        }


def _distance(fixes: list[Fix]) -> float:
    """The way between the poses that are known [m], in legs of a decimetre."""
    total, anchor = 0.0, None
    for fix in fixes:
        if fix.status == "lost":
            anchor = None
        elif anchor is None or fix.status == "localised":
            anchor = fix.pose[:2]
        elif (leg := np.hypot(*(fix.pose[:2] - anchor))) >= _LEG:
            total, anchor = total + float(leg), fix.pose[:2]
    return total


def _last(fixes: list[Fix]) -> dict | None:
    """The last pose that is known."""
    known = [n for n, fix in enumerate(fixes) if fix.status != "lost"]
    if not known:
        return None
    fix = fixes[known[-1]]
    sigma = np.sqrt(np.diagonal(np.asarray(fix.covariance, float)))
    return {"scan": known[-1], "pose": fix.pose.tolist(), "sigma": sigma.tolist()}


@contextmanager
def _compilations() -> Iterator[Callable[[], int]]:
    """A function that counts what JAX had to compile, or to load compiled, so far."""
    seen = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            seen.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield lambda: len(seen)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def scan_times(log: ScanLog) -> tuple[Float[np.ndarray, "scans"], list[str]]:
    """A time for each scan, and what is odd about the log, the times included."""
    remarks = list(log.remarks)
    if log.stamps is None:
        remarks.append("the log has no times: the trajectory counts scans, from 0")
        return np.arange(len(log), dtype=float), remarks
    if none := int(np.sum(~np.isfinite(log.stamps))):
        remarks.append(f"{none} of {len(log)} scans have no time: no trajectory there")
    return log.stamps, remarks


def picture_path(plot: Path | None, out: Path | None, name: str) -> Path | None:
    """Where a run's picture goes, if there is to be one.

    Raises:
        ValueError: there is no such folder.
    """
    if plot == Path("none"):
        return None
    if plot is None:
        return Path(name) if out is None else out / name
    if plot.parent != out and not plot.absolute().parent.is_dir():
        raise ValueError(f"there is no folder {plot.parent} for the picture {plot}")
    return plot


def new_folder(path: Path) -> None:
    """Make a run's folder.

    Raises:
        ValueError: something is there; earlier runs are not written over.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"{path} exists and is no empty folder; choose another")
    path.mkdir(parents=True, exist_ok=True)


def circumstances() -> dict:
    """When, with what, and on what."""
    return {
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": sys.argv,
        "versions": {"python": platform.python_version()}
        | {name: found for name in _PACKAGES if (found := _version(name))},
        "commit": _commit(),
        "machine": platform.platform(),
        "device": str(jax.devices()[0]),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Of the checkout that the package is part of, with -dirty if it was changed."""
    here = Path(__file__).parents[1] / "__init__.py"
    said = None
    for command in (
        ("ls-files", "--error-unmatch", here.name),
        ("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"),
    ):
        git = ["git", "-C", str(here.parent), *command]
        try:
            said = subprocess.run(git, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
    return said.stdout.strip() if said else None


def write_json(path: Path, content: dict) -> None:
    """Numbers, text, lists and dictionaries; arrays become lists."""
    plain = lambda value: np.asarray(value).tolist()
    text = dumps(content, indent=2, ensure_ascii=False, default=plain)
    path.write_text(text + "\n", encoding="utf-8")
