"""Descent on CAER, in any of its forms and by any of four methods.

All minimise the same sum of kernel costs over the valid rays (`caer_at`). They differ
in what they make of the exact derivative of the virtual scan:

- "gauss_newton" weighs the rays by their kernel and solves for the step at once;
- "levenberg_marquardt" does so carefully: a step must lower the cost, or is shortened;
- "lbfgs" (optax) learns the curvature from gradients and compares steps along a line;
- "adam" (optax) needs nothing but gradients, and many of them.

Each runs in stages. The first has the kernel widened, so that rays far off still
pull; each further stage narrows it, until the kernel is the one asked for (graduated
non-convexity). Of all poses on the way the one of least cost is kept, the start among
them, so that the answer is never worse than the guess. Gradients mix metres and
radians: for the two methods of optax the heading is counted in metres at the mean
range, which makes one step size good for all three numbers.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import caer_per_ray
from fsmsm_jax.alignment.kernels import GemanMcClure, Kernel
from fsmsm_jax.alignment.residuals import gauss_newton_step, range_residuals
from fsmsm_jax.sensing import Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["METHODS", "Refined", "refine"]

METHODS = {"gauss_newton": 8, "levenberg_marquardt": 8, "lbfgs": 6, "adam": 40}
"""The methods, and how many steps a stage each takes unless told otherwise."""

_DAMPING = 1e-4  # of Gauss-Newton; Levenberg and Marquardt's starts at _CAREFUL
_CAREFUL, _EASIER, _HARDER = 1e-3, 0.3, 5.0  # and its factors after good and bad steps
_STRIDE = 0.01  # [m] first step of Adam in the last stage; wider stages stride wider
_LENGTHS = 10  # steps compared along one line, each half as long as the one before
_LEVERS = 0.5, 20.0  # [m] limits of the mean range as a lever arm
_LONGEST = 0.5  # [m] a line search may go at once: gradients reach no farther
_SETTLED = 0.01  # [m] and [rad] that one more Gauss-Newton step would go


class Refined(NamedTuple):
    """Where descent ended."""

    pose: Float[Array, "3"]
    """Pose [x, y, θ] of least cost on the way [m, m, rad], map frame; always finite."""
    cost: Float[Array, ""]
    """Sum of kernel costs over the valid rays there [m]; never above the start's. Where
    walls are drawn thick and the method knows it (see `thickness`), after that."""
    caer_per_ray: Float[Array, ""]
    """Mean |real − virtual range| over the valid rays there [m]; inf if none is."""
    converged: Bool[Array, ""]
    """Whether some ray meets a wall and one more Gauss-Newton step would go nowhere:
    less than 1 cm, less than 0.01 rad."""
    thickness: Float[Array, ""]
    """How much nearer than the real walls a grid draws them [m], as estimated by
    Gauss-Newton and Levenberg-Marquardt; 0 on polygons and for the others."""


def refine(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    method: str = "gauss_newton",
    kernel: Kernel = GemanMcClure(),
    steps: int | None = None,
    widening: Sequence[ScalarLike] = (8.0, 4.0, 2.0, 1.0),
) -> Refined:
    """Descend from a guess to the pose that explains the scan best.

    Args:
        world: the map.
        scan: the real scan, any field of view; its valid rays count.
        pose: finite guess [x, y, θ] of the lidar in the map [m, m, rad].
        method: a name in `METHODS`; static.
        kernel: what a ray costs.
        steps: steps in each stage, those of `METHODS` if left out; static.
        widening: factor of the kernel, stage after stage; (1,) suffices within cm.

    Returns:
        The pose and what to think of it.

    Raises:
        ValueError: no such method, no positive number of steps, or no stage.

    Example:
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [2, 4]])
        >>> bearings = jnp.linspace(-2.0, 2.0, 120)
        >>> ranges = raycast(room, jnp.array([3.0, 2.0, 0.5]), bearings)
        >>> scan = Scan.from_bearings(ranges, bearings)
        >>> found = refine(room, scan, jnp.array([3.1, 1.9, 0.4]))
        >>> [round(v, 3) for v in found.pose.tolist()], bool(found.converged)
        ([3.0, 2.0, 0.5], True)

    Note:
        Written for one pose: `jax.vmap(refine, (None, None, 0))` refines candidates
        against one scan. A step of Gauss-Newton casts one virtual scan, one of
        Levenberg-Marquardt too, one of Adam two, and one of L-BFGS 12. On grids the
        first two estimate the walls' thickness as well (`fit_ranges` says why).
        `fit.fit_ranges` is sharper where the noise is Gaussian and unknown.
    """
    if method not in METHODS:
        raise ValueError(f"no method {method!r}: choose from {', '.join(METHODS)}")
    steps = METHODS[method] if steps is None else steps
    if steps < 1 or not len(widening):
        raise ValueError(
            "expected at least one step in at least one stage, got "
            f"steps={steps} and {len(widening)} stages"
        )
    factors = jnp.stack([jnp.asarray(f, pose.dtype) for f in widening])
    return _refine(world, scan, pose, method, kernel, steps, factors)


class _Problem(NamedTuple):
    """What a method descends on: a state is [x, y, θ, thickness of the walls]."""

    world: OccupancyGrid | PolygonMap
    scan: Scan
    kernel: Kernel
    """Of this stage."""
    factor: Float[Array, ""]
    """By which it is widened."""

    def cost(self, e):
        """Sum of kernel costs [m] of residuals."""
        return jnp.sum(self.kernel.cost(e), where=self.scan.valid)

    def weights(self, e):
        return jnp.where(self.scan.valid, self.kernel.weight(e), 0.0)

    def errors(self, pose):
        """Residuals [m] of a pose, to be differentiated by autodiff."""
        cast = raycast(self.world, pose, self.scan.bearings, self.scan.range_max)
        return self.scan.ranges - cast

    def residuals(self, state):
        """Residuals [m] and their Jacobian; only walls that are met have thickness."""
        e, J, known = range_residuals(self.world, self.scan, state[:3], state[3])
        thick = known & isinstance(self.world, OccupancyGrid)
        slant = jnp.where(thick, J[:, 3], 0.0)
        return e + state[3] * (J[:, 3] - slant), J.at[:, 3].set(slant)


@partial(jax.jit, static_argnames=("method", "steps"))
def _refine(world, scan, pose, method, kernel, steps, factors):
    begin, step = _DESCENTS[method](steps)
    wanted = _Problem(world, scan, kernel, jnp.ones((), pose.dtype))

    def stage(carry, factor):
        problem = wanted._replace(kernel=kernel.widened(factor), factor=factor)

        def one(carry, _):
            walker, best = carry
            walker, tried, e = step(problem, walker)
            return (walker, _better(best, tried, wanted.cost(e))), None

        state, best = carry
        walker = begin(problem, state)
        (walker, best), _ = jax.lax.scan(one, (walker, best), length=steps)
        return (walker[0], best), None

    state = jnp.append(pose, 0.0)
    best = state, jnp.asarray(jnp.inf, pose.dtype)
    (state, best), _ = jax.lax.scan(stage, (state, best), factors)
    best, cost = _better(best, state, wanted.cost(wanted.residuals(state)[0]))

    e, J = wanted.residuals(best)
    w = wanted.weights(e)
    J_pose = J.at[:, 3].set(0.0)
    ahead = gauss_newton_step(best, e, J_pose, w, _DAMPING) - best
    ahead = jnp.abs(ahead.at[2].set(geometry.wrap(ahead[2])))
    plain = e + best[3] * J[:, 3]
    return Refined(
        pose=best[:3].at[2].set(geometry.wrap(best[2])),
        cost=cost,
        caer_per_ray=caer_per_ray(plain, jnp.zeros_like(plain), scan.valid),
        converged=jnp.all(ahead < _SETTLED) & jnp.any(w[:, None] * J_pose != 0),
        thickness=best[3],
    )


def _better(best, state, cost):
    """The best so far, or a state of less cost. One without a cost is never better."""
    less = cost < best[1]
    return jnp.where(less, state, best[0]), jnp.where(less, cost, best[1])


# A method is `begin(problem, state) -> walker`, at the start of a stage, and
# `step(problem, walker) -> walker, state, residuals of that state`. A walker is a tuple
# whose first entry is the state it stands at.


def _gauss_newton(steps):
    del steps

    def begin(problem, state):
        return (state,)

    def step(problem, walker):
        (state,) = walker
        e, J = problem.residuals(state)
        ahead = gauss_newton_step(state, e, J, problem.weights(e), _DAMPING)
        return (ahead,), state, e

    return begin, step


def _levenberg_marquardt(steps):
    del steps

    def begin(problem, state):
        return state, *problem.residuals(state), jnp.asarray(_CAREFUL, state.dtype)

    def step(problem, walker):
        state, e, J, damping = walker
        ahead = gauss_newton_step(state, e, J, problem.weights(e), damping)
        there = ahead, *problem.residuals(ahead), _EASIER * damping
        here = state, e, J, _HARDER * damping
        lower = problem.cost(there[1]) < problem.cost(e)
        walker = jax.tree.map(partial(jnp.where, lower), there, here)
        return walker, state, e

    return begin, step


def _adam(steps):
    def optimiser(problem):
        return optax.adam(optax.cosine_decay_schedule(1.0, steps))

    def begin(problem, state):
        return state, optimiser(problem).init(state)

    def step(problem, walker):
        state, memory = walker
        unit = _metres(problem.scan)

        def mean(u):
            e = problem.errors((u / unit)[:3])
            return problem.cost(e) / e.size, e

        slope, e = jax.grad(mean, has_aux=True)(state * unit)
        turn, memory = optimiser(problem).update(slope, memory)
        stride = _STRIDE * problem.factor
        return (state + stride * turn / unit, memory), state, e

    return begin, step


def _lbfgs(steps):
    del steps
    # optax's own line search may never end under `vmap`: all lengths at once instead.
    optimiser = optax.scale_by_lbfgs(memory_size=4)
    lengths = 0.5 ** jnp.arange(_LENGTHS)

    def begin(problem, state):
        return state, optimiser.init(state)

    def step(problem, walker):
        state, memory = walker
        unit = _metres(problem.scan)

        def mean(u):
            e = problem.errors((u / unit)[:3])
            return problem.cost(e) / e.size, e

        (value, e), slope = jax.value_and_grad(mean, has_aux=True)(state * unit)
        update, memory = optimiser.update(slope, memory, state * unit)
        turn = jnp.asarray(update)
        # Where the objective bends the wrong way, what was learned may point uphill.
        turn = -jnp.where(jnp.sum(turn * slope) > 0, turn, slope)
        turn = jnp.clip(turn, -_LONGEST, _LONGEST)
        ahead = (state * unit)[None] + lengths.astype(state.dtype)[:, None] * turn[None]
        costs = jax.vmap(lambda u: mean(u)[0])(ahead)
        best = jnp.argmin(costs)
        there = jnp.where(costs[best] < value, ahead[best] / unit, state)
        return (there, memory), state, e

    return begin, step


def _metres(scan):
    """[1, 1, mean range, 1]: with the heading times this all of a state is metres."""
    total = jnp.sum(scan.ranges, where=scan.echo)
    lever = jnp.clip(total / jnp.maximum(jnp.sum(scan.echo), 1), *_LEVERS)
    return jnp.ones(4, scan.ranges.dtype).at[2].set(lever)


_DESCENTS = {
    "gauss_newton": _gauss_newton,
    "levenberg_marquardt": _levenberg_marquardt,
    "lbfgs": _lbfgs,
    "adam": _adam,
}
