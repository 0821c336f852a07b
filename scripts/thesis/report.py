"""Tables as text and as markdown, numbers with their intervals, and the clock's report."""

import os
import platform
import subprocess
import sys
import time
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, SupportsFloat

import jax
from matplotlib.figure import Figure

from fsmsm_jax.evaluation import Estimate

ROOT = Path(__file__).resolve().parents[2]
_DPI, _COLOURS = 110, 96  # of a picture: a palette keeps it small


class Table(NamedTuple):
    """What one part of a section found."""

    title: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
    note: str = ""

    def text(self) -> str:
        """In columns, as wide as they need to be."""
        lines = [self.head, *self.rows]
        widths = [max(map(_width, column)) for column in zip(*lines, strict=True)]
        body = ("  ".join(map(_padded, line, widths)).rstrip() for line in lines)
        return "\n".join([f"== {self.title}", *_noted(self.note), *body, ""])

    def markdown(self) -> str:
        """With a heading, for a document."""
        rule = "|".join(["---"] * len(self.head))
        lines = [f"| {' | '.join(line)} |" for line in (self.head, *self.rows)]
        return "\n".join(
            [f"### {self.title}", "", lines[0], f"|{rule}|", *lines[1:], ""]
            + [line for note in _noted(self.note) for line in (note, "")]
        )


def _noted(note: str) -> list[str]:
    return [note] if note else []


def _width(text: str) -> int:
    """Columns on a terminal: combining accents take none."""
    return sum(not unicodedata.combining(letter) for letter in text)


def _padded(text: str, width: int) -> str:
    return text + " " * (width - _width(text))


def number(value: SupportsFloat, digits: int = 3) -> str:
    """Significant digits, no exponents where they can be helped."""
    value = float(value)
    if value == 0 or 1e-3 <= abs(value) < 10**digits:
        return f"{float(f'{value:.{digits}g}'):g}"
    return f"{value:.0f}" if 10**digits <= abs(value) < 1e6 else f"{value:.1e}"


def interval(estimate: Estimate, scale: float = 1.0, digits: int = 3) -> str:
    """`value [low, high]`."""
    value, low, high = (number(scale * v, digits) for v in estimate)
    return f"{value} [{low}, {high}]"


def pair(numbers: Sequence[SupportsFloat] | None, scale: float = 1.0) -> str:
    """`median / mean`, or nothing."""
    return (
        "" if numbers is None else " / ".join(number(scale * float(n)) for n in numbers)
    )


def percent(estimate: Estimate) -> str:
    """`value [low, high]` of a share, in percent."""
    low, high = (f"{100 * v:.2f}".rstrip("0").rstrip(".") for v in estimate[1:])
    return f"{100 * estimate.value:.2f} [{low}, {high}]"


def save(figure: Figure, folder: Path | None, name: str) -> None:
    """Write a picture and say where; without a folder, neither."""
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=_DPI, bbox_inches="tight")
    _shrink(path)
    print(f"picture: {path}", file=sys.stderr)


def _shrink(path: Path) -> None:
    """Replace 16 million colours by a few: a tenth of the size, no visible loss."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def circumstances() -> dict[str, str]:
    """Where, with what and of which commit this was measured."""
    describe = ["git", "describe", "--always", "--dirty"]
    git = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True)
    load = f", load {os.getloadavg()[0]:.1f} at the start"
    return {
        "command": " ".join(["python", *sys.argv]),
        "commit": git.stdout.strip() or "unknown",
        "device": f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores{load}",
        "jax": f"{jax.__version__}, {jax.numpy.asarray(1.0).dtype}",
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m-%d"),
    }
