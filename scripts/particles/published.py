"""What the thesis printed: medians over 100 navigations of the mean ‖e‖ (§4)."""

from typing import NamedTuple


class Published(NamedTuple):
    """Medians of ‖e‖ in (m² + rad²)^½, particle filter alone and after scan matching."""

    corridor: tuple[float, float]
    warehouse: tuple[float, float]


SELECTIONS = {
    "heaviest 10 %": Published((0.01283, 0.01151), (0.0436, 0.0265)),
    "above the mean": Published((0.01390, 0.01162), (0.0473, 0.0268)),
    "all": Published((0.01474, 0.01163), (0.0483, 0.0266)),
    "heaviest one": Published((0.01598, 0.01156), (0.0905, 0.0286)),
}
"""From best to worst, as the thesis found."""

FEEDBACKS = {
    "open": Published((0.01474, 0.01163), (0.0483, 0.0266)),
    "soft_1": Published((0.01138, 0.01154), (0.0634, 0.0278)),
    "soft_50": Published((0.01136, 0.01155), (0.0272, 0.0258)),
    "hard": Published((0.01164, 0.01173), (0.0303, 0.0295)),
}
