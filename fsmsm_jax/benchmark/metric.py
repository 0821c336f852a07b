"""A row of a table of measurements, and what it means that it got worse.

A number alone says little. A `Metric` says what was measured, in which unit, which way
is better, how much it scattered, what was hoped for, and by how much it may get worse
than a baseline before somebody has to look. `regressions` does the looking.

Machines differ and are shared, so rows of seconds inform; rows that are held against a
baseline are shares, errors, and times in units of a reference workload (`clock`).
"""

from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["Metric", "regressions"]


class Metric(NamedTuple):
    """One row."""

    key: str
    """Section and quantity, `section/quantity`."""
    value: float
    unit: str
    direction: str = "higher"
    """Which way is better: "higher" or "lower"."""
    goal: float | None = None
    """What the project wants; None where a row only informs."""
    rel_tol: float | None = None
    """Share of the baseline by which it may get worse; None is not gated."""
    spread: Sequence[float] | None = None
    """Lower and upper quartile of the repetitions; None where there was one."""

    @property
    def section(self) -> str:
        """The part of the key before the slash."""
        return self.key.split("/")[0]

    @property
    def met(self) -> bool | None:
        """Whether the goal is met."""
        return None if self.goal is None else self.reaches(self.goal)

    def reaches(self, bound: float) -> bool:
        """Whether the value is on the good side of a bound, or on it. NaN is not."""
        sign = 1 if self.direction == "higher" else -1
        return sign * self.value >= sign * bound - 1e-9


def regressions(rows: Sequence[Metric], baseline: Sequence[Metric]) -> list[str]:
    """What got worse than the baseline by more than its tolerance, or is gone.

    Sections that did not run at all (no recordings here, others asked for) are not
    compared; a row that the baseline does not know is nothing to be worse than.

    Example:
        >>> was = Metric("query/ratio", 2.0, "× reference", "lower", rel_tol=0.5)
        >>> regressions([was._replace(value=2.9)], [was])
        []
        >>> regressions([was._replace(value=3.1)], [was])
        ['query/ratio is 3.1 × reference, was 2; 3 would do']
    """
    now = {row.key: row for row in rows}
    ran = {row.section for row in rows}
    worse = []
    for old in baseline:
        new = now.get(old.key)
        if new is None:
            if old.section in ran:
                worse.append(f"{old.key} is in the baseline but was not measured")
        elif new.rel_tol is not None:
            slack = new.rel_tol if new.direction == "lower" else -new.rel_tol
            allowed = old.value * (1 + slack)
            if not new.reaches(allowed):
                worse.append(
                    f"{new.key} is {new.value:.4g} {new.unit}, was {old.value:.4g}; "
                    f"{allowed:.4g} would do"
                )
    return worse
