"""The evaluation of chapter 7: five recordings, six displacements, five noises."""

from collections.abc import Iterator

import numpy as np
from thesis.main_table import thesis_weights, weighted_middle
from thesis.report import Table, number, pair
from thesis.worlds import Options, five_sets, progress

from fsm import published
from fsm.pairs import FAITHFUL, FAST, WAYS, Answers, answers, of_the_thesis, pairs_of
from fsmsm_jax.evaluation import DISPLACEMENTS

_QUANTITIES = (
    ("position", "Position errors [mm]", published.POSITION),
    ("orientation", "Orientation errors [mrad]", published.ORIENTATION),
)


def protocol(options: Options) -> Iterator[Table]:
    """Every cell of the thesis's table, the published beside ours."""
    deltas = (5,) if options.quick else range(len(DISPLACEMENTS))
    sigmas = published.SIGMAS[2:3] if options.quick else published.SIGMAS
    found: dict[tuple[str, int, float], Answers] = {}
    described, weights = "", None
    for delta in deltas:
        asked = five_sets(options, key=delta, displacement=DISPLACEMENTS[delta])
        weights = thesis_weights(asked)
        configs = of_the_thesis(DISPLACEMENTS[delta])
        described = asked.described
        for sigma in sigmas:
            pairs = pairs_of(asked.cases, sigma)
            for way in WAYS:
                found[way, delta, sigma] = answers(pairs, configs[way])
                each = 1e3 * found[way, delta, sigma].seconds
                progress(f"protocol: Δ{delta}, σ {sigma:g}, {way}: {each:.2f} ms")
    if weights is None:
        weights = np.full(len(next(iter(found.values())).position), 1.0)
        weights /= weights.sum()
    generated = "generated" in described
    for field, title, theirs in _QUANTITIES:
        middle = {
            key: weighted_middle(getattr(a, field), weights) for key, a in found.items()
        }
        rows = []
        for _, delta, sigma in (key for key in found if key[0] == FAST):
            fast, faithful = middle[FAST, delta, sigma], middle[FAITHFUL, delta, sigma]
            fsm = theirs["FSM"][delta, sigma]
            over = lambda ours, fsm=fsm: [
                1e3 * a / b for a, b in zip(ours, fsm, strict=True)
            ]
            others = ("FastGICP", "NDT", "PLICP")
            rows.append(
                (
                    f"Δ{delta}",
                    f"{sigma:g}",
                    pair(fast, 1e3),
                    pair(faithful, 1e3),
                    pair(fsm),
                    "" if generated else pair(over(fast)),
                    "" if generated else pair(over(faithful)),
                    *(pair(theirs.get(o, {}).get((delta, sigma))) for o in others),
                    number(100 * np.mean(found[FAST, delta, sigma].converged), 4),
                )
            )
        yield Table(
            f"Scan against scan: {title}, median / mean",
            (
                *("δ", "σ_R [m]", "ours, fast", "ours, faithful", "thesis: FSM"),
                *("fast / thesis", "faithful / thesis"),
                *("FastGICP", "NDT", "PLICP", "fast converged [%]"),
            ),
            rows,
            f"A cell: {described} Recordings are weighed by size, as in the thesis. "
            "Ours are told how far the guess may be off, δ, as the thesis's is.",
        )
