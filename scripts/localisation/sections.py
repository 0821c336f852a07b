"""The sections about scans: each yields the rows of its name."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from localisation.rates import (
    among_candidates,
    efficiency,
    errors,
    percent,
    query_times,
    rates,
)
from localisation.sets import (
    Options,
    ask,
    atlas_of,
    office_set,
    real_set,
    simulated_set,
    world_of,
)

from fsmsm_jax.benchmark import Metric, ratio_to_reference, rays_from
from fsmsm_jax.evaluation import success
from fsmsm_jax.localisation import localise
from fsmsm_jax.sensing import raycast


def office(options: Options) -> Iterator[Metric]:
    """The building that everyone has, and the clock that CI can trust."""
    cases = office_set(options.limit or 50)
    answers = ask(cases.map, cases.scans, "office")
    yield from rates("office", cases, answers)
    yield from errors("office", cases, answers, gated=True)
    yield from query_times("office", answers)
    atlas, scan = atlas_of(None), cases.scans[0]
    ratio = ratio_to_reference(lambda: localise(atlas, scan))
    yield Metric("office/query_ratio", ratio, "× reference", "lower", None, 1.5)
    cast = rays_from(world_of(None), 1024, 360)
    yield Metric(
        "office/raycast_ratio",
        ratio_to_reference(cast),
        "× reference",
        "lower",
        None,
        1.5,
    )


def real(
    name: str,
    options: Options,
    *,
    right: float,
    precise: bool = False,
    query: float | None = None,
) -> Iterator[Metric]:
    """An honest split: one scan, no prior; errors have goals if poses are `precise`."""
    cases = real_set(name, options)
    answers = ask(cases.map, cases.scans, name)
    yield from rates(name, cases, answers, right)
    goals = (3.0, 0.3) if precise else (None, None)
    yield from errors(name, cases, answers, *goals, gated=True)
    yield from query_times(name, answers, query)


def infinite_corridor(options: Options) -> Iterator[Metric]:
    """232 m by 198 m of long equal corridors, 180°; the map was made of other scans."""
    name = "infinite-corridor"
    cases = real_set(name, options)
    answers = ask(cases.map, cases.scans, name)
    yield from rates(name, cases, answers, right=90, wrong_goal=1.0)
    yield from among_candidates(name, cases, answers, goal=97)
    yield from errors(name, cases, answers)
    yield from query_times(name, answers, goal=250)


def simulated(
    name: str, options: Options, *, right: float, query: float | None = None
) -> Iterator[Metric]:
    """Big maps, 360 rays: how near to the bound that physics sets?"""
    cases, exact = simulated_set(name, options)
    answers = ask(cases.map, cases.scans, name)
    yield from rates(name, cases, answers, right, limit=0.5)
    near = success(jnp.asarray(answers.poses), jnp.asarray(cases.poses), 0.05)
    yield Metric(f"{name}/within_5cm", percent(near), "%", "higher", right)
    yield from errors(name, cases, answers, limit=0.5, unit="mm")
    yield from efficiency(name, cases, answers)
    yield from query_times(name, answers, query)

    scan, poses = cases.scans[0], jnp.asarray(cases.poses, float)
    cast = lambda pose: raycast(
        world_of(cases.map), pose, scan.bearings, scan.range_max
    )
    ranges = jax.jit(jax.vmap(cast))(poses)
    off = np.abs(ranges - np.minimum(exact, float(scan.range_max))) > 0.1
    yield Metric(f"{name}/rays_off", percent(off), "% > 0.1 m", "lower", 0.1)


def off_map(options: Options) -> Iterator[Metric]:
    """Scans of another building: whatever comes out must not be believed."""
    splits = {name: real_set(f"{name}_first60", options) for name in ("csail", "intel")}
    for scanned, mapped in (("csail", "intel"), ("intel", "csail")):
        key = f"off_map/{scanned}_on_{mapped}"
        answers = ask(splits[mapped].map, splits[scanned].scans, key)
        yield Metric(f"{key}_confident", percent(answers.confident), "%", "lower", 0.5)
