"""The filters by name: what each particle draws, when, and how it keeps the map.

| method | drawn | by | landmarks |
|---|---|---|---|
| `ekf` | nothing (one particle) | | joint |
| `fastslam1` | pose | motion | one filter each |
| `fastslam2` | pose | motion and look | one filter each |
| `lslam` | heading | motion | one filter each, sharing the position |
| `lslam2` | heading | motion and look | one filter each, sharing the position |
| `lslam_joint` | heading | motion | joint |
| `lslam2_joint` | heading | motion and look | joint |

Particles must cover what is drawn: three numbers need more of them than one, and a
draw that knows what was seen needs fewer than one that does not. What is not drawn is
carried by Kalman filters. `lslam2` is ours: the heading is drawn from its posterior,
the position integrated out, where the paper draws it from the motion model.
"""

from typing import Literal, NamedTuple

__all__ = ["METHODS", "Method", "Name"]

Name = Literal[
    "ekf",
    "fastslam1",
    "fastslam2",
    "lslam",
    "lslam2",
    "lslam_joint",
    "lslam2_joint",
]


class Method(NamedTuple):
    """A member of the family."""

    draws: tuple[int, ...]
    """Coordinates of the pose that a particle draws, in this order."""
    looks_first: bool
    """Whether it draws after the look rather than before."""
    expected: bool
    """Whether sights are linearised at the expected landmark (EKF) or the detection."""
    joint: bool = False
    """Whether all correlations of landmarks are kept."""

    @property
    def free(self) -> int:
        """Coordinates that the look finds open."""
        return 3 if self.looks_first or not self.draws else 3 - len(self.draws)

    @property
    def left(self) -> int:
        """Coordinates that are open when landmarks are corrected."""
        return 3 - len(self.draws)


_POSE, _HEADING = (2, 0, 1), (2,)
METHODS: dict[Name, Method] = {
    "ekf": Method((), looks_first=False, expected=True, joint=True),
    "fastslam1": Method(_POSE, looks_first=False, expected=True),
    "fastslam2": Method(_POSE, looks_first=True, expected=True),
    "lslam": Method(_HEADING, looks_first=False, expected=False),
    "lslam2": Method(_HEADING, looks_first=True, expected=False),
    "lslam_joint": Method(_HEADING, looks_first=False, expected=False, joint=True),
    "lslam2_joint": Method(_HEADING, looks_first=True, expected=False, joint=True),
}
