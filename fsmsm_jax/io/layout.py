"""Rows of rays as they come, some shorter than others, become rectangular arrays.

All scans of a log have one shape, so that one compiled function serves them all. Each
row keeps its own bearings, so a driver that changes its layout mid-log does no harm.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

__all__ = ["stack_rows"]

_SAME = 1e-5  # [rad]: steps that differ by less are one layout, rounded


def stack_rows(
    rows: Sequence[np.ndarray],
    first: Float[np.ndarray, "scans"],
    step: Float[np.ndarray, "scans"],
) -> tuple[
    Float[np.ndarray, "scans rays"], Float[np.ndarray, "scans rays"], tuple[str, ...]
]:
    """Ranges, bearings and remarks of scans with evenly spaced rays.

    Args:
        rows: ranges of each scan [m], of any lengths.
        first: bearing of each scan's first ray [rad].
        step: bearing from ray to ray [rad]; where this or `first` is not finite, or
            the step is 0, the scan does not say where it looks and is emptied.

    Returns:
        Ranges [m], short rows padded with NaN; bearings [rad], all finite; what was
        mended, in sentences.
    """
    counts = np.array([len(row) for row in rows])
    ranges = np.full((len(rows), counts.max()), np.nan)
    for row, values in zip(ranges, rows, strict=True):
        row[: len(values)] = values
    lost = ~(np.isfinite(first) & np.isfinite(step) & (step != 0))
    ranges[lost] = np.nan
    first, step = np.where(lost, 0.0, first), np.where(lost, 0.0, step)
    bearings = first[:, None] + step[:, None] * np.arange(counts.max())

    remarks = []
    if lost.any():
        remarks.append(
            f"{lost.sum()} of {len(rows)} scans do not say where their rays point and "
            "were emptied"
        )
    short = counts < counts.max()
    if short.any():
        remarks.append(
            f"{short.sum()} of {len(rows)} scans have fewer than {counts.max()} rays, "
            f"down to {counts.min()}, and were padded"
        )
    turned = np.any(np.abs(np.diff([first, step])) > _SAME, axis=0)
    changes = np.sum(turned & ~lost[1:] & ~lost[:-1])
    if changes:
        remarks.append(
            f"the directions of the rays change {changes} times, each scan has its own"
        )
    return ranges, bearings, tuple(remarks)
