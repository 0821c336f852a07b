r"""A match in about ten virtual scans: Fourier into the basin, Gauss-Newton to the end.

The thesis asks the map again after every guess, some 250 times a match. But a virtual
scan cast with its derivative answers more than it was asked. Seen from one place,

1. **turn**: correlation ranks all headings at once, and the best distinct few stay;
2. **lean**: for each of these the shifted scan S_V and its shifted derivative J say,
   without another cast, where the sensor should stand and how well that would explain
   the real scan: robust least squares on $S_R \approx S_V + J \delta$;
3. **look**: only the most promising are cast again, and step by Gauss-Newton;
4. **finish**: the one that explains most is fitted to the bound (`fit.fit_ranges`).

Every step has a fixed length: one item, any number of them by `vmap`, no straggler.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import truncated_caer_per_ray
from fsmsm_jax.alignment.fit import fit_ranges
from fsmsm_jax.alignment.residuals import gauss_newton_step, geman_mcclure
from fsmsm_jax.alignment.theseus import distinct_headings
from fsmsm_jax.sensing import Scan, raycast_with_jacobian
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["FastConfig", "approach", "fast_match"]

_LEAN = (2.0, 1.0, 0.7, 0.5, 0.3)  # [m] kernel scales, without a cast
_LOOK = (0.6, 0.4, 0.3)  # [m] the same after each cast
_DAMPING = 1e-2  # share of the rays' weight: a corridor's length stays as estimated


class FastConfig(eqx.Module):
    """How the fast matcher goes about it."""

    headings: int = eqx.field(default=10, static=True)
    """Distinct headings that are considered."""
    kept: int = eqx.field(default=4, static=True)
    """Of these, how many are cast again."""
    looks: int = eqx.field(default=1, static=True)
    """How often."""
    finish: int = eqx.field(default=5, static=True)
    """Gauss-Newton steps at the end."""
    apart: ScalarLike = 0.05
    """Least angle between two headings [rad]."""
    cap: ScalarLike = 0.5
    """Rays that differ by more [m] count just this much when poses are compared."""
    box: tuple[ScalarLike, ScalarLike] = (0.2, math.pi / 4)
    """Half width of the box around the estimate in which the pose lies [m, rad]."""
    stray: ScalarLike = 1.3
    """Answers may lie this many boxes away from the estimate."""

    def __check_init__(self):
        if min(self.headings, self.kept, self.looks, self.finish) < 1:
            raise ValueError(
                "headings, kept, looks and finish count from 1, got "
                f"{self.headings}, {self.kept}, {self.looks}, {self.finish}"
            )

    @property
    def scans(self) -> int:
        """Virtual scans cast in a match."""
        return 1 + self.kept * self.looks + self.finish


def fast_match(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    panorama: Scan,
    pose: Float[Array, "3"],
    config: FastConfig = FastConfig(),
) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """The pose of a scan, given about where it was taken.

    Args:
        world: the map.
        scan: the real scan as it is; the finish fits its own rays.
        panorama: the same as N equiangular rays (`sensing.panorama`), for the turn.
        pose: estimate [x, y, θ] of the sensor in the map frame [m, m, rad].
        config: settings.

    Returns:
        The pose of the sensor in the map frame, always finite, and the thickness of
        the walls as drawn [m] (`fit_ranges`).

    Note:
        Pure and of fixed length, for `vmap` and `jit`. `match` checks its input, judges
        the answer and adds the covariance; this is the engine.
    """
    found = approach(world, panorama, pose, config)
    return fit_ranges(world, scan, found, config.finish, config.box[0])


def approach(
    world: OccupancyGrid | PolygonMap,
    panorama: Scan,
    pose: Float[Array, "3"],
    config: FastConfig = FastConfig(),
) -> Float[Array, "3"]:
    """`fast_match` up to the finish: turn, lean and look. Centimetres are missing."""
    look = lambda pose: raycast_with_jacobian(
        world, pose, panorama.bearings, panorama.range_max
    )
    reach = config.stray * jnp.asarray(config.box, pose.dtype)
    virtual, J = look(pose)
    veiled = isinstance(world, PolygonMap) and world.solid is not None
    turns = distinct_headings(
        panorama.ranges,
        virtual,
        0.0,
        reach[1],
        config.headings,
        jnp.asarray(config.apart),
        panorama.valid,
        virtual < panorama.range_max if veiled else None,
    ).corrections

    def lean(turn):
        shift = jnp.round(turn * virtual.size / (2 * jnp.pi)).astype(int)
        turned = jnp.roll(virtual, -shift), jnp.roll(J, -shift, axis=0)
        step, cost = _fit_linear(turned, panorama, _LEAN, config.cap)
        return _held(pose + step.at[2].add(turn), pose, reach), cost

    def step(state, _):
        now, _ = state
        step, cost = _fit_linear(look(now), panorama, _LOOK, config.cap)
        return (_held(now + step, pose, reach), cost), None

    leaned, costs = jax.vmap(lean)(turns)
    _, best = jax.lax.top_k(-costs, config.kept)
    walk = lambda start: jax.lax.scan(step, start, length=config.looks)[0]
    walked, costs = jax.vmap(walk)((leaned[best], costs[best]))
    return walked[jnp.argmin(costs)]


def _fit_linear(view, scan, scales, cap):
    """Robust least squares on S_R ≈ S_V + J δ, and what CAER would be left."""
    virtual, J = view
    e = scan.ranges - virtual
    used = scan.echo & (virtual < scan.range_max)

    def step(delta, scale):
        left = e - J @ delta
        w = jnp.where(used, geman_mcclure(left, scale), 0.0)
        return gauss_newton_step(delta, left, J, w, _DAMPING), None

    delta, _ = jax.lax.scan(step, jnp.zeros(3, e.dtype), jnp.asarray(scales, e.dtype))
    there = jnp.minimum(virtual + J @ delta, scan.range_max)
    return delta, truncated_caer_per_ray(scan.ranges, there, cap, scan.valid)


def _held(pose, start, reach):
    """The pose, no farther from the start than the reach [m, rad]."""
    far = jnp.stack([reach[0], reach[0], reach[1]])
    away = pose - start
    away = jnp.clip(away.at[2].set(geometry.wrap(away[2])), -far, far)
    held = start + away
    return held.at[2].set(geometry.wrap(held[2]))
