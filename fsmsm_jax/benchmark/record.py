"""Measurements kept: with what, where and of which commit they were taken.

A table without its circumstances cannot be compared with another, so the two are one
file. One such file for each kind of device lies in `baselines/`, in the package, and is
committed: `fsmsm bench --gate` compares with the one of the device it runs on, and the
README's page is made of all of them.
"""

import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax

from fsmsm_jax.benchmark.metric import Metric

__all__ = [
    "Record",
    "baseline_path",
    "baselines",
    "circumstances",
    "read_record",
    "write_record",
]

_ROOT = Path(__file__).resolve().parents[2]
_BASELINES = Path(__file__).with_name("baselines")


class Record(NamedTuple):
    """Rows, and how they came about."""

    circumstances: dict[str, str]
    rows: list[Metric]


def circumstances() -> dict[str, str]:
    """Where, with what and of which commit something is measured."""
    return {
        "command": " ".join([_program(sys.argv[0]), *sys.argv[1:]]),
        "commit": _commit(),
        "device": f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores",
        "jax": jax.__version__,
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }


def _program(path: str) -> str:
    """A script is told with Python, a command by its name."""
    return f"python {path}" if path.endswith(".py") else Path(path).name


def _commit() -> str:
    """Of the checkout that this file lies in, or the version that is installed."""
    if (_ROOT / ".git").exists():
        describe = ["git", "describe", "--always", "--dirty"]
        git = subprocess.run(describe, cwd=_ROOT, capture_output=True, text=True)
        if git.returncode == 0:
            return git.stdout.strip()
    try:
        return f"version {metadata.version('fsmsm-jax')}"
    except metadata.PackageNotFoundError:
        return "unknown"


def write_record(path: Path, rows: Sequence[Metric]) -> None:
    """Keep rows and their circumstances as JSON."""
    record = circumstances() | {"metrics": [row._asdict() for row in rows]}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


def read_record(path: Path) -> Record:
    """What `write_record` wrote.

    Raises:
        ValueError: there is nothing there, or it is no such file.
    """
    try:
        record = json.loads(path.read_text())
        rows = [Metric(**row) for row in record.pop("metrics")]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"no measurements can be read from {path} ({error}); "
            "measure with --write-baseline or --json"
        ) from error
    return Record(record, rows)


def baseline_path(kind: str | None = None) -> Path:
    """Where the baseline of a kind of device is kept; by default, of the first one.

    Example:
        >>> baseline_path("NVIDIA H100 80GB HBM3").name
        'nvidia-h100-80gb-hbm3.json'
    """
    kind = jax.devices()[0].device_kind if kind is None else kind
    return _BASELINES / f"{re.sub('[^a-z0-9]+', '-', kind.lower()).strip('-')}.json"


def baselines() -> list[Record]:
    """Of all kinds of devices, by name."""
    return [read_record(path) for path in sorted(_BASELINES.glob("*.json"))]
