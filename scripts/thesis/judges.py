"""What chooses among candidates, §6.3: percent discrimination and CAER."""

import math
from collections.abc import Iterator

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import rankdata
from thesis.report import Table, number, percent, save
from thesis.worlds import Options, five_sets, laserazos, progress

from fsmsm_jax.alignment import theseus
from fsmsm_jax.evaluation import caer_pairs, heading_candidates, share_of
from fsmsm_jax.plotting import plot_caer, plot_similarity


def similarity(options: Options) -> Iterator[Table]:
    """Percent discrimination as a judge, at the true position and 0.2 m off."""
    asked = laserazos(options, worlds=200)
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    rows = []
    for ax, offset in zip(axes, (0.0, 0.2), strict=True):
        progress(f"orientation: percent discrimination, {offset} m off")
        found = heading_candidates(
            jax.random.key(11),
            asked.cases,
            theseus,
            3,
            turn=math.pi / 4,
            offset=offset,
        )
        size = np.abs(np.asarray(found.error))
        plot_similarity(ax, size, np.asarray(found.similarity))
        place = (
            f"up to {offset:g} m off in x and y" if offset else "at the true position"
        )
        ax.set(title=place, xlabel="residual orientation error [mrad]")
        if offset:
            ax.set_ylabel("")
        best, every = np.argmin(size, axis=1), np.arange(len(size))
        picks = {
            "PD": np.argmax(found.similarity, axis=1),
            "CAER": np.argmin(found.caer, axis=1),
            "best": best,
        }
        for judge, pick in picks.items():
            errors = 1e3 * size[every, pick]
            rows.append(
                (
                    f"{offset:g}",
                    judge,
                    number(np.median(errors)),
                    number(np.mean(errors)),
                    percent(share_of(pick == best)),
                )
            )
    axes[0].legend(frameon=False, fontsize=8, loc="upper left")
    yield Table(
        "Who chooses among the 8 candidates of ν = 3 best",
        ("offset [m]", "judge", "median [mrad]", "mean", "chose the best [%]"),
        rows,
        f"{asked.described} No noise, Δθ in ±π/4. Off position, percent discrimination "
        "judges badly (Remark XVI), and CAER before the rehearsal no better.",
    )
    save(figure, options.out, "similarity")


def pairs(options: Options) -> Iterator[Table]:
    """Does less CAER mean less pose error? (Remark XVIII)"""
    asked = five_sets(options)
    count = len(asked.sets)
    levels = ((0.0, 0.0), (0.05, 0.0), (0.05, 0.05))
    shown = (0.05, 0.0)
    rows = []
    for sigma_R, sigma_M in levels[1:2] if options.quick else levels:
        every = (sigma_R, sigma_M) == shown
        wanted = options.pairs if every else max(2 * count, options.pairs // 10)
        progress(f"pairs: {wanted} at σ_R {sigma_R}, σ_M {sigma_M}")
        found = caer_pairs(jax.random.key(13), asked.cases, wanted, sigma_R, sigma_M)
        error = np.hypot(np.asarray(found.position), np.asarray(found.orientation))
        caer, inside = np.asarray(found.caer), np.asarray(found.inside)
        rank = np.corrcoef(rankdata(error[inside]), rankdata(caer[inside]))[0, 1]
        rows.append(
            (
                f"{sigma_R:g}",
                f"{sigma_M:g}",
                str(wanted),
                number(100 * np.mean(inside), 4),
                number(rank),
                *_concordance(error, caer, inside, count),
            )
        )
        if every:
            figure = Figure(figsize=(5.5, 4), layout="constrained")
            ax = figure.add_subplot()
            mesh, _ = plot_caer(ax, error[inside], caer[inside])
            ax.set(xlabel=r"pose error $\sqrt{dx^2 + dy^2 + d\theta^2}$ [m, rad]")
            ax.legend(frameon=False, loc="lower right")
            figure.colorbar(mesh, ax=ax, label="pairs")
            save(figure, options.out, "caer")
    yield Table(
        "CAER against pose error",
        (
            "σ_R [m]",
            "σ_M [m]",
            "pairs",
            "inside [%]",
            "rank correlation",
            "right of two, any [%]",
            "right of two, one error twice the other [%]",
        ),
        rows,
        f"{asked.described} Of two estimates of one pose, how often has the nearer one "
        "less CAER? δ = (0.20 m, π/4).",
    )


def _concordance(error, caer, inside, cases: int) -> tuple[str, str]:
    """How often CAER tells the nearer one of two estimates of the same pose."""
    whole = len(error) // (2 * cases) * 2 * cases
    first, second = (
        [a[:whole].reshape(-1, 2, cases)[:, k].ravel() for a in (error, caer, inside)]
        for k in (0, 1)
    )
    both = first[2] & second[2]
    right = (first[0] < second[0]) == (first[1] < second[1])
    ratio = np.maximum(first[0], second[0]) / np.minimum(first[0], second[0])
    clear = both & (ratio > 2)
    return percent(share_of(right[both])), percent(share_of(right[clear]))
