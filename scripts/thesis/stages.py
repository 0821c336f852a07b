"""The stages on their own, §6.2 and §6.3: orientation from the true position, and
position with the true heading."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from thesis import published
from thesis.judges import similarity
from thesis.report import Table, interval, number, percent, save
from thesis.worlds import Options, laserazos, progress

from fsmsm_jax.alignment import Candidates, sinis, theseus, translate
from fsmsm_jax.evaluation import (
    FARTHEST,
    Cases,
    rotation_row,
    translation_walk,
)
from fsmsm_jax.plotting import (
    POSE,
    RIVAL,
    SCAN,
    plot_convergence,
    plot_path,
    plot_world,
)
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import PolygonMap

RAYS = 360


def by_sinis(ranges, fine) -> Candidates:
    """Sinis, who has one answer only, as `heading_candidates` wants it."""
    found = sinis(ranges, fine)
    nothing = jnp.zeros((1,), ranges.dtype)
    return Candidates(found.correction[None], found.similarity[None], nothing)


first_principles = partial(theseus, method="first_principles")


def orientation(options: Options) -> Iterator[Table]:
    """From the true position: is it within γ / 2^(1+ν), and how far off is x1?"""
    asked = laserazos(options, worlds=778)
    cases, key = asked.cases, jax.random.key(10)
    rows = []
    for degree in range(1 if options.quick else 4):
        progress(f"orientation: ν = {degree}")
        ask = lambda method, by, nu=degree: (
            rotation_row(key, cases, method, nu, by=by).within
        )
        rows.append(
            (
                str(degree),
                percent(ask(theseus, "similarity")),
                percent(ask(theseus, "caer")),
                percent(ask(by_sinis, "similarity")),
                str(published.WITHIN_BOUND[degree]),
            )
        )
    yield Table(
        "Orientation alone, no noise: within γ / 2^(1+ν) [%]",
        ("ν", "Theseus, by PD", "Theseus, by CAER", "Sinis", "PD, 150 star rooms"),
        rows,
        f"{asked.described} True position, Δθ in ±π. The thesis calls the bound certain "
        "(eq. 4.28); the last column is an independent check (erratum E5).",
    )

    rows = []
    for sigma_M, theirs in (
        (0.0, published.X1_ROTATION),
        (0.05, published.X1_ROTATION_ON_CORRUPTED_MAP),
    ):
        for rays in (360,) if options.quick else published.X1_ROTATION:
            progress(f"orientation: x1, N_s = {rays}, σ_M = {sigma_M}")
            errors = (
                rotation_row(
                    key, cases, first_principles, 0, rays, sigma_R, sigma_M
                ).error
                for sigma_R in published.X1_SIGMAS
            )
            beside = theirs.get(rays, ("",) * 4)
            rows.append(
                (f"{sigma_M:g}", str(rays))
                + tuple(
                    f"{interval(e.mean, 1e3)} | {t}"
                    for e, t in zip(errors, beside, strict=True)
                )
            )
    yield Table(
        "Orientation alone: x1, mean error [mrad] | thesis",
        ("σ_M [m]", "N_s", *(f"σ_R = {s:g} m" for s in published.X1_SIGMAS)),
        rows,
        f"{asked.described} True position, Δθ in ±π; the thesis asks each 100 times.",
    )
    yield from similarity(options)


START, GOAL = (4.0, -4.0), (0.83, -0.98)


def _hall(repeats: int) -> Cases:
    """A hall of 360 walls that holds the thesis's two points, with draws of noise."""
    a = 2 * np.pi * np.arange(RAYS) / RAYS - np.pi
    radius = 8 + 1.2 * np.cos(2 * a + 0.6) + 0.4 * np.sin(3 * a)
    outline = radius[:, None] * np.stack([np.cos(a), np.sin(a)], axis=-1)
    true = jnp.array([*GOAL, 0.4])
    outlines = jnp.asarray(np.tile(outline, (repeats, 1, 1)), float)
    world = PolygonMap.from_outlines(outline)
    bearings = jnp.asarray(np.linspace(-np.pi, np.pi, RAYS, endpoint=False), float)
    ranges = raycast(world, true, bearings, FARTHEST)
    key_range, key_map = jax.random.split(jax.random.key(12))
    return Cases(
        outlines=outlines,
        true=jnp.tile(true[None], (repeats, 1)),
        initial=jnp.tile(jnp.array([[*START, 0.4]]), (repeats, 1)),
        ranges=jnp.tile(ranges[None], (repeats, 1)),
        z_range=jax.random.normal(key_range, (repeats, RAYS)),
        z_map=jax.random.normal(key_map, outlines.shape),
    )


def position(options: Options) -> Iterator[Table]:
    """The position law alone, heading known: 4.4 m in one go."""
    progress("position")
    repeats, iterations = (20 if options.quick else 400), 40
    hall = _hall(repeats)
    one = jax.tree.map(lambda a: a[:1], hall)
    exact = np.asarray(translation_walk(hall, iterations).position[:1])
    rough = np.asarray(translation_walk(hall, iterations, 0.05, 0.05).position)
    with jax.enable_x64(True):
        one64 = jax.tree.map(lambda a: a[:1], _hall(1))
        double = np.asarray(translation_walk(one64, iterations).position)
    steps = [0, 1, 2, 3, 5, 8, 12, 16, 20, 25, 30, 40]
    middle = np.median(rough, axis=0)
    rows = [
        tuple([str(step), *(number(e[step]) for e in (exact[0], double[0], middle))])
        for step in steps
    ]
    rows.append(
        (
            "thesis, final",
            "",
            number(published.POSITION_ALONE[0.0]),
            number(published.POSITION_ALONE[0.05]),
        )
    )
    yield Table(
        "The position law alone: error [m] after each step",
        (
            "step",
            f"no noise, {hall.true.dtype}",
            "no noise, float64",
            "σ_R = σ_M = 0.05 m, median",
        ),
        rows,
        f"From {START} to {GOAL}, heading known, N_s = {RAYS}, in a hall made up to hold "
        f"both; {repeats} draws of the noise. The thesis has one draw in a world that it "
        "does not name, in doubles, and stops at a step of its choice.",
    )
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    plot_world(left, PolygonMap.from_outlines(np.asarray(hall.outlines[0])))
    plot_path(left, _path(one, iterations))
    left.plot(*GOAL, "+", color=SCAN, ms=12, mew=2)
    left.set(xlabel="x [m]", ylabel="y [m]")
    plot_convergence(right, double, "no noise, float64", RIVAL)
    plot_convergence(right, exact, f"no noise, {hall.true.dtype}", POSE)
    plot_convergence(right, rough, "σ_R = σ_M = 0.05 m", SCAN)
    right.set(xlabel="step", ylabel="position error [m]")
    right.legend(frameon=False)
    save(figure, options.out, "position")


def _path(case: Cases, iterations: int) -> np.ndarray:
    """Where the law went: the same walk, with all of its poses."""
    world = PolygonMap.from_outlines(np.asarray(case.outlines[0]))
    poses = [case.initial[0]]
    step = jax.jit(lambda pose: translate(world, case.ranges[0], pose, 1).pose)
    for _ in range(iterations):
        poses.append(step(poses[-1]))
    return np.asarray(jnp.stack(poses))
