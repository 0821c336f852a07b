r"""The stages of matching, each on its own: turn, step, choose.

A matcher hides which of its parts lost the millimetres. Here each part gets what it
cannot be blamed for: orientation the true position (Remark VIII of the thesis: from
elsewhere no method could be right), position the true heading, and the metrics that
choose among candidates, CAER and percent discrimination, poses whose error is known.

The sampling degree ν stands for 2^ν virtual scans whose headings divide the angle
γ = 2π/N between two rays; one cast of 2^ν N rays holds them all. A method that answers
in whole rays can then be right to γ / 2^(1+ν), though it need not (erratum E5).

A method of orientation is any function of the real scan and the finer virtual one that
answers as `alignment.theseus` does: `partial(theseus, method="first_principles")`, say.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fsmsm_jax import geometry
from fsmsm_jax.alignment import Candidates, caer_per_ray, theseus, translate
from fsmsm_jax.evaluation.cases import (
    FARTHEST,
    Cases,
    as_worlds,
    bearings,
    noisy,
    noisy_ranges,
)
from fsmsm_jax.evaluation.estimates import Estimate, Spread, share_of, spread_of
from fsmsm_jax.evaluation.metrics import pose_errors
from fsmsm_jax.sensing import raycast

__all__ = [
    "HeadingErrors",
    "Pairs",
    "RotationRow",
    "Walk",
    "caer_pairs",
    "heading_candidates",
    "rotation_row",
    "translation_walk",
]

Method = Callable[[Float[Array, "rays"], Float[Array, "fine"]], Candidates]
"""(N real ranges, 2^ν N virtual ranges) → 2^ν corrections and what speaks for them."""


class HeadingErrors(NamedTuple):
    """The 2^ν answers to each case, in the order of the virtual scans."""

    error: Float[Array, "cases candidates"]
    """Heading of the candidate minus the true one [rad], in [−π, π)."""
    similarity: Float[Array, "cases candidates"]
    """Percent discrimination of each: the thesis takes the greatest."""
    caer: Float[Array, "cases candidates"]
    """CAER per ray of each [m], still at the same position."""


def heading_candidates(
    key: PRNGKeyArray,
    cases: Cases,
    method: Method = theseus,
    degree: int = 0,
    rays: int = 360,
    turn: float = math.pi,
    offset: float = 0.0,
    sigma_R: float | Float[Array, ""] = 0.0,
    sigma_M: float | Float[Array, ""] = 0.0,
    batch: int = 16,
) -> HeadingErrors:
    """Percent discrimination against residual error, on position or off it.

    Args:
        key: of the displacements and the ranges' noise.
        cases: worlds, true poses and the draws of the map's noise.
        method: of orientation.
        degree: ν.
        rays: N_s of both scans; they are cast anew.
        turn: the heading estimate is uniform within ± this around the truth [rad].
        offset: the same for the position, in x and in y [m]; 0 is on position.
        sigma_R: standard deviation of the real ranges [m].
        sigma_M: standard deviation of the map's vertices [m].
        batch: cases worked on at once.

    Reference:
        Thesis §6.3 and Remark XVI: on position the most similar candidate is nearly
        the best, off position any may be.
    """
    keys = jax.random.split(key, len(cases.true))
    displacement = jnp.asarray([offset, offset, turn], cases.true.dtype)
    sigmas = jnp.asarray(sigma_R, float), jnp.asarray(sigma_M, float)
    return _heading_candidates(
        keys, cases, method, degree, rays, displacement, *sigmas, batch
    )


@jax.jit(static_argnames=("method", "degree", "rays", "batch"))
def _heading_candidates(
    keys, cases, method, degree, rays, displacement, sigma_R, sigma_M, batch
):
    a = bearings(rays, cases.true.dtype)
    fine = bearings(rays * 2**degree, cases.true.dtype)

    def one(args):
        key, outline, z_map, true = args
        key_pose, key_noise = jax.random.split(key)
        away = jax.random.uniform(key_pose, (3,), true.dtype, -1.0, 1.0)
        pose = true + displacement * away
        exact = raycast(as_worlds(outline), true, a, FARTHEST)
        z = jax.random.normal(key_noise, a.shape, a.dtype)
        real = noisy_ranges(exact, z, sigma_R)
        seen = raycast(as_worlds(outline + sigma_M * z_map), pose, fine, FARTHEST)
        found = method(real, seen)
        error = geometry.wrap(pose[2] + found.corrections - true[2])
        return HeadingErrors(error, found.similarity, found.caer)

    xs = (keys, cases.outlines, cases.z_map, cases.true)
    return jax.lax.map(one, xs, batch_size=min(batch, len(keys)))


class RotationRow(NamedTuple):
    """A method of orientation from the true position."""

    error: Spread
    """Absolute heading error of the chosen candidate [rad]."""
    within: Estimate
    """Share of cases within γ / 2^(1+ν), the thesis's bound (4.28)."""
    errors: Float[np.ndarray, "cases"]
    """The signed errors [rad], in [−π, π)."""


def rotation_row(
    key: PRNGKeyArray,
    cases: Cases,
    method: Method = theseus,
    degree: int = 0,
    rays: int = 360,
    sigma_R: float = 0.0,
    sigma_M: float = 0.0,
    turn: float = math.pi,
    by: str = "similarity",
    batch: int = 16,
) -> RotationRow:
    """Orientation alone, l̂ = l: by ν for Fourier-Mellin, by N_s, σ_R and σ_M for x1.

    The arguments are those of `heading_candidates`; `by` chooses among its candidates:
    the greatest "similarity", as published, or the least "caer".

    Raises:
        ValueError: `by` is another word.

    Reference:
        Thesis §6.2 and §6.3; erratum E5 on the bound.
    """
    if by not in ("similarity", "caer"):
        raise ValueError(f"by must be 'similarity' or 'caer', got {by!r}")
    found = heading_candidates(
        key, cases, method, degree, rays, turn, 0.0, sigma_R, sigma_M, batch
    )
    best = np.argmin(-found.similarity if by == "similarity" else found.caer, axis=1)
    errors = np.asarray(found.error)[np.arange(len(best)), best]
    bound = 2 * math.pi / rays / 2 ** (1 + degree)
    rounding = 10 * float(np.finfo(errors.dtype).eps)
    size = np.abs(errors)
    return RotationRow(spread_of(size), share_of(size <= bound + rounding), errors)


class Walk(NamedTuple):
    """Where the position was before the first step and after each one."""

    position: Float[Array, "cases iterations+1"]
    """Distance from the true position [m]."""
    caer: Float[Array, "cases iterations+1"]
    """CAER per ray there [m]."""


def translation_walk(
    cases: Cases,
    iterations: int = 20,
    sigma_R: float | Float[Array, ""] = 0.0,
    sigma_M: float | Float[Array, ""] = 0.0,
    batch: int = 64,
) -> Walk:
    """Position alone, θ known: the error after each step of `alignment.translate`.

    Args:
        cases: from their initial position, with the true heading; N_s as in `ranges`.
        iterations: steps.
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of the map's vertices [m].
        batch: cases worked on at once.

    Reference:
        tc_x1, Algorithm XIX of the thesis as printed: no gate; Theorem I.
    """
    sigmas = jnp.asarray(sigma_R, float), jnp.asarray(sigma_M, float)
    return _walk(cases, iterations, *sigmas, batch)


@jax.jit(static_argnames=("iterations", "batch"))
def _walk(cases, iterations, sigma_R, sigma_M, batch):
    worlds, ranges = noisy(cases, sigma_R, sigma_M)
    start = cases.initial.at[:, 2].set(cases.true[:, 2])

    def one(args):
        world, ranges, pose, true = args

        def step(pose, _):
            after = translate(world, ranges, pose, 1, range_max=FARTHEST)
            off, _ = pose_errors(pose, true)
            return after.pose, Walk(off, after.caers[0] / ranges.size)

        return jax.lax.scan(step, pose, length=iterations + 1)[1]

    xs = (worlds, ranges, start, cases.true)
    return jax.lax.map(one, xs, batch_size=min(batch, len(start)))


class Pairs(NamedTuple):
    """Random pairs of a true and an estimated pose."""

    position: Float[Array, "pairs"]
    """Distance between the two [m]."""
    orientation: Float[Array, "pairs"]
    """Angle between the two [rad], at least 0."""
    caer: Float[Array, "pairs"]
    """CAER per ray of their scans [m]."""
    inside: Bool[Array, "pairs"]
    """Whether the estimate lies in the map; elsewhere its scan means nothing."""


def caer_pairs(
    key: PRNGKeyArray,
    cases: Cases,
    pairs: int,
    sigma_R: float | Float[Array, ""] = 0.0,
    sigma_M: float | Float[Array, ""] = 0.0,
    offset: float = 0.2,
    turn: float = math.pi / 4,
    batch: int = 256,
) -> Pairs:
    """Does less CAER mean less pose error? Many random pairs to see it.

    Pair i is of case i modulo the number of cases: its true pose, and an estimate
    uniform around it. Every pair has noise of its own in the real scan; the map's is
    the case's.

    Args:
        key: of the estimates and the ranges' noise.
        cases: worlds, true poses, scans.
        pairs: how many; the thesis has 10⁵.
        sigma_R: standard deviation of the ranges [m].
        sigma_M: standard deviation of the map's vertices [m].
        offset: largest displacement along x and along y [m].
        turn: largest displacement in heading [rad].
        batch: pairs worked on at once.

    Reference:
        Thesis §6.3, Remark XVIII.

    Note:
        A pair costs one virtual scan: 10⁶ of them some minutes on two CPU cores.
    """
    displacement = jnp.asarray([offset, offset, turn], cases.true.dtype)
    sigmas = jnp.asarray(sigma_R, float), jnp.asarray(sigma_M, float)
    return _caer_pairs(key, cases, pairs, displacement, *sigmas, batch)


@jax.jit(static_argnames=("pairs", "batch"))
def _caer_pairs(key, cases, pairs, displacement, sigma_R, sigma_M, batch):
    rays = cases.ranges.shape[1]
    a = bearings(rays, cases.true.dtype)
    outlines = cases.outlines + sigma_M * cases.z_map

    def one(args):
        key, case = args
        key_pose, key_noise = jax.random.split(key)
        true = cases.true[case]
        away = jax.random.uniform(key_pose, (3,), true.dtype, -1.0, 1.0)
        pose = true + displacement * away
        z = jax.random.normal(key_noise, (rays,), true.dtype)
        real = noisy_ranges(cases.ranges[case], z, sigma_R)
        world = as_worlds(outlines[case])
        virtual = raycast(world, pose, a, FARTHEST)
        return Pairs(
            *pose_errors(pose, true),
            caer=caer_per_ray(real, virtual),
            inside=world.contains(pose[:2]),
        )

    xs = (jax.random.split(key, pairs), jnp.arange(pairs) % len(cases.true))
    return jax.lax.map(one, xs, batch_size=min(batch, pairs))
