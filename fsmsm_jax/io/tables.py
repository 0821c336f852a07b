"""Numbers in text and in MATLAB files, with errors that say what is wrong.

A table is a text of one row a line; lines that begin with # are comments. A recorder
that was switched off leaves its last line unfinished: that line is left out. Any other
line that is no row makes the file another one than was expected, and that is an error,
not a gap.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

__all__ = ["read_mat", "read_table", "rows_of"]


def read_table(path: Path, columns: int) -> Float[np.ndarray, "rows {columns}"]:
    """The first columns of a table, split by commas or blanks; there may be more.

    Args:
        path: the file.
        columns: how many each row must have at least.

    Raises:
        ValueError: the file is missing or has no rows, or a line is no row of as many
            numbers.
    """
    if not path.is_file():
        raise ValueError(f"there is no file {path}")

    def first(fields):
        row = [float(field) for field in fields[:columns]]
        if len(row) < columns:
            raise ValueError(f"{len(row)} numbers instead of {columns}")
        return row

    rows = rows_of(path, first, f": expected {columns} numbers", separator=",")
    if not rows:
        raise ValueError(f"{path.name} holds no rows of {columns} numbers")
    return np.array(rows, float)


def rows_of(
    path: Path,
    parse: Callable[[list[str]], list[float]],
    what: str,
    separator: str = " ",
) -> list[list[float]]:
    """The rows of a text, without blank lines, comments and a last line torn off.

    Args:
        path: the file; it must be there.
        parse: from a line's fields to its row; raises ValueError where it is none.
        what: is said of such a line, after its number.
        separator: what splits fields beside blanks.

    Raises:
        ValueError: a line is no row.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        fields = line.replace(separator, " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            rows.append(parse(fields))
        except ValueError as error:
            if number == len(lines) and not text.endswith("\n"):
                break
            raise ValueError(f"{path.name}, line {number}{what}: {error}") from error
    return rows


def read_mat(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The variables of these names in a MATLAB file.

    Raises:
        ValueError: the file is missing, torn or no MATLAB file of version 4 to 7, or a
            variable is not in it.
    """
    from scipy.io import loadmat

    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    try:
        found = loadmat(path)
    except Exception as error:  # scipy raises whatever a torn file makes it stumble on
        raise ValueError(
            f"{path.name} is no MATLAB file that can be read, or it is torn: {error}"
        ) from error
    missing = [name for name in names if name not in found]
    if missing:
        raise ValueError(
            f"{path.name} lacks {missing}; it holds "
            f"{sorted(name for name in found if not name.startswith('__'))}"
        )
    return {name: found[name] for name in names}
