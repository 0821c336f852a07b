"""What the thesis printed of PGL-FMIC (§5): read off its figures, shares within 1 %."""

from typing import NamedTuple


class Published(NamedTuple):
    """For σ = 0.01, 0.02 and 0.05 m, averaged over an environment's poses."""

    poses: int
    hypotheses: int
    invalid: tuple[float, float, float]
    """Solutions a metre or more off [%]."""
    metres: tuple[float, float, float]
    """Mean position error of the valid ones."""
    radians: tuple[float, float, float]
    """Mean heading error of the valid ones."""
    milliseconds: str
    """A hypothesis, on one of 12 threads at 4 GHz, without writing the pictures."""


NOISES = (0.01, 0.02, 0.05)

ENVIRONMENTS = {
    "corridor": Published(
        *(3, 100),
        invalid=(0.0, 0.0, 0.3),
        metres=(0.0398, 0.0432, 0.0398),
        radians=(0.0054, 0.0059, 0.0046),
        milliseconds="277-284",
    ),
    "home": Published(
        *(11, 200),
        invalid=(13.5, 13.6, 14.6),
        metres=(0.125, 0.126, 0.128),
        radians=(0.0045, 0.0038, 0.0034),
        milliseconds="356",
    ),
    "warehouse": Published(
        *(7, 200),
        invalid=(14.7, 15.3, 14.9),
        metres=(0.094, 0.088, 0.082),
        radians=(0.0085, 0.0069, 0.0066),
        milliseconds="377-383",
    ),
    "willowgarage": Published(
        *(10, 500),
        invalid=(17.1, 17.8, 20.0),
        metres=(0.116, 0.116, 0.119),
        radians=(0.0055, 0.0051, 0.0235),
        milliseconds="369",
    ),
}
"""Those whose maps are at hand; LANDFILL's is not, and CSAL's scans are not."""
