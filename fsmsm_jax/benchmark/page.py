"""Measurements on a page: columns for a terminal, a table for the README.

Nobody types numbers into the README. Its table stands between two marks and is written
anew from the committed baselines, so page and baselines cannot disagree.
"""

from collections.abc import Sequence

from fsmsm_jax.benchmark.metric import Metric
from fsmsm_jax.benchmark.record import Record

__all__ = ["BEGIN", "END", "HEAD", "cells", "line", "markdown", "with_page"]

BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"
HEAD = ("metric", "value", "unit", "better", "quartiles", "device", "commit")
_WIDTHS = (23, 9, 15, 7, 18, 16, 0)
_DIGITS = 3  # significant ones


def cells(row: Metric, facts: dict[str, str]) -> tuple[str, ...]:
    """The words of a row under `HEAD`.

    Example:
        >>> row = Metric("query/speed", 41.2345, "ms", "lower", spread=(40.0, 1234.5))
        >>> cells(row, {"device": "cpu, 2 cores", "commit": "abc1234"})[:5]
        ('query/speed', '41.2', 'ms', 'lower', '40.0 to 1234')
    """
    spread = "" if row.spread is None else " to ".join(map(_number, row.spread))
    words = (row.key, _number(row.value), row.unit, row.direction, spread)
    return (*words, facts["device"], facts["commit"])


def _number(value: float) -> str:
    """Three significant digits, and all of those before the point."""
    if abs(value) >= 10**_DIGITS:
        return f"{value:.0f}"
    return f"{value:#.{_DIGITS}g}".rstrip(".")


def line(words: Sequence[str]) -> str:
    """Cells in columns, for a terminal."""
    pairs = zip(words, _WIDTHS, strict=True)
    return "  ".join(word.ljust(width) for word, width in pairs).rstrip()


def markdown(records: Sequence[Record]) -> str:
    """One table of all records; ratios, which only the gate wants, are left out."""
    lines = [HEAD, ("---",) * len(HEAD)]
    for record in records:
        told = [row for row in record.rows if not row.key.endswith("/ratio")]
        lines += [cells(row, record.circumstances) for row in told]
    return "\n".join(f"| {' | '.join(words)} |" for words in lines)


def with_page(document: str, page: str) -> str:
    r"""The document with what stands between its two marks replaced by the page.

    Raises:
        ValueError: the marks are not there, once each and in order.

    Example:
        >>> with_page(f"# Speed\n{BEGIN}\nold\n{END}\n", "new").splitlines()
        ['# Speed', '<!-- bench:begin -->', 'new', '<!-- bench:end -->']
    """
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end) or BEGIN in rest or END in before + after:
        raise ValueError(
            f"expected one {BEGIN} and after it one {END} where the table belongs; "
            "write these two lines into the file"
        )
    return f"{before}{BEGIN}\n{page}\n{END}{after}"
