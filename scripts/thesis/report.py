"""What scripts that print tables have in common: sections, numbers, pictures, folders."""

import argparse
import os
import platform
import subprocess
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat

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


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """A parser that says of itself what the script's docstring says."""
    summary, _, details = (doc or "").partition("\n\n")
    return argparse.ArgumentParser(
        description=summary,
        epilog=details,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def find_folder(variable: str, name: str) -> Path | None:
    """A folder of other people's data, or None."""
    path = Path(os.environ.get(variable, ROOT.parent / "shared" / name))
    if path.is_dir():
        return path
    print(f"nothing at {path}; point {variable} at it", file=sys.stderr)
    return None


def print_sections(
    sections: Mapping[str, Callable[[Any], Iterator[Table]]],
    names: Sequence[str] | None,
    options: Any,
    markdown: Path | None,
) -> None:
    """Print these sections, or all, table by table as they are measured."""
    facts = [f"{key:9} {value}" for key, value in circumstances().items()]
    print("\n".join(facts), "\n", flush=True)
    document = ["```", *facts, "```", ""]
    for name in names or sections:
        start = time.perf_counter()
        for table in sections[name](options):
            print(table.text(), flush=True)
            document.append(table.markdown())
        print(f"... {name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
        if markdown:  # after each section, so that no hour is lost
            markdown.write_text("\n".join(document))
