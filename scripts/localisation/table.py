"""Rows as text, goals and what others reach beside them."""

from collections.abc import Sequence

from fsmsm_jax.benchmark import Metric

# What others reach, measured on a like machine or as they state it; for comparison.
PEERS = {
    "cbgl_willow/right": "CBGL 74 as published, 98 repaired, 100 improved",
    "cbgl_warehouse/right": "CBGL 82 as published, 100 repaired and improved",
    "basement_5cm/right": "CBGL 74 as published, 96 repaired, 92 improved",
    "cbgl_willow/within_5cm": "CBGL 74, 96, 100",
    "cbgl_warehouse/within_5cm": "CBGL 82, 100, 100",
    "basement_5cm/within_5cm": "CBGL 72, 90, 90",
    "cbgl_willow/position": "CBGL 6.1 repaired, 3 to 6 improved",
    "cbgl_warehouse/position": "CBGL 7.3 repaired, 3 to 6 improved",
    "basement_5cm/position": "CBGL 13.3 repaired, 3 to 6 improved",
    "cbgl_willow/query": "CBGL 3200",
    "cbgl_warehouse/query": "CBGL 1870",
    "basement_5cm/query": "CBGL 1510",
    "cbgl_willow/rays_off": "range_libc 1 to 25, plain C++ 0",
    "basement_5cm/rays_off": "range_libc 1 to 25, plain C++ 0",
    "raycast/cbgl_willow": "range_libc 2.9 to 7.9, plain C++ 4.5 (one thread)",
    "raycast/basement_5cm": "range_libc 2.1 to 11.5, plain C++ 3.6 (one thread)",
}


def cells(row: Metric) -> tuple[str, str, str, str, str]:
    """Key, value with unit, goal, verdict and peers of a row, as text."""
    sign = "≥" if row.direction == "higher" else "≤"
    goal = "" if row.goal is None else f"{sign} {row.goal:g}"
    verdict = {None: "", True: "met", False: "MISSED"}[row.met]
    whole = isinstance(row.value, int) or abs(row.value) >= 100
    digits = 0 if whole else 1 if abs(row.value) >= 10 else 2
    value = f"{row.value:.{digits}f} {row.unit}"
    return row.key, value, goal, verdict, PEERS.get(row.key, "")


def line(row: Metric) -> str:
    key, value, goal, verdict, peers = cells(row)
    return f"{key:38} {value:>17} {goal:>7} {verdict:6}  {peers}".rstrip()


def markdown(rows: Sequence[Metric]) -> str:
    """The rows that have a goal or a peer, for the README."""
    rows = [row for row in rows if row.goal is not None or row.key in PEERS]
    head = "| measured | value | goal | | others |\n|---|---|---|---|---|"
    return "\n".join([head, *(f"| {' | '.join(cells(row))} |" for row in rows)])
