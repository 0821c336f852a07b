r"""How likely is a scan from where a particle stands?

Thousands of particles ask, so the answer must be cheap. A **likelihood field** casts no
ray: each end point looks up the distance d to the nearest wall, one gather a ray, and

    p = z_hit exp(−d²/2σ²) + z_rand / range_max.

Rays seen from one place share their errors, so their product claims far more than they
know: ten rays off by σ weigh as much as one off by three. ROS's amcl therefore does
not multiply. Its weight is 1 + Σ p³, which tells good from bad and hardly good from
better; the thesis's particles were weighed like this, and that is the default. The
**product** is there for those who want to know where they are after one scan.

**CAER** casts the rays and compares ranges: dearer, and it knows which wall a ray
should meet first. Its weight is exp(−CAER per ray / scale).

Reference: S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, §6.4; amcl's
`LikelihoodFieldModel`; thesis §4 and eq. 6.32.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.caer import truncated_caer_per_ray
from fsmsm_jax.sensing import Scan, raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["CaerLikelihood", "LikelihoodField", "log_likelihoods"]

_RULES = ("sum_of_cubes", "product")


class LikelihoodField(eqx.Module):
    """End points near walls; the defaults are those of the thesis's amcl."""

    rays: int = eqx.field(default=60, static=True)
    """Rays that are looked up, spread evenly over the informative ones."""
    rule: str = eqx.field(default="sum_of_cubes", static=True)
    """How rays are put together: "sum_of_cubes", 1 + Σ p³, or "product"."""
    z_hit: ScalarLike = 0.95
    """Weight of an end point on a wall."""
    z_rand: ScalarLike = 0.05
    """Weight of one anywhere."""
    sigma_hit: ScalarLike = 0.2
    """How far from a wall an end point still counts as on it [m]."""

    def __check_init__(self):
        if self.rays < 1:
            raise ValueError(f"at least one ray must be looked up, got {self.rays}")
        if self.rule not in _RULES:
            raise ValueError(f"rule must be one of {_RULES}, got {self.rule!r}")


class CaerLikelihood(eqx.Module):
    """Ranges as the map says; rays are cast from every particle."""

    rays: int = eqx.field(default=60, static=True)
    """Rays that are cast, spread evenly over the informative ones."""
    scale: ScalarLike = 0.05
    """CAER per ray that makes a particle e times less likely [m]."""
    cap: ScalarLike = 0.5
    """Rays that differ by more count just this much [m]."""

    def __check_init__(self):
        if self.rays < 1:
            raise ValueError(f"at least one ray must be cast, got {self.rays}")


def log_likelihoods(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    poses: Float[Array, "particles 3"],
    model: LikelihoodField | CaerLikelihood = LikelihoodField(),
) -> Float[Array, "particles"]:
    """Log-likelihood of a scan from each pose, up to a constant [nats].

    Args:
        world: the map.
        scan: one scan, any number of rays.
        poses: of the lidar in the map [m, m, rad].
        model: what to compare, by its type: end points or ranges.

    Returns:
        One number a pose; all alike for a scan without information (no echo for the
        field, no valid ray for CAER). −inf only if the field's `z_rand` is 0.
    """
    scan = scan.thin(model.rays)
    if isinstance(model, LikelihoodField):
        return _by_end_points(world, scan, poses, model)
    cast = lambda pose: raycast(world, pose, scan.bearings, scan.range_max)
    caer = lambda virtual: truncated_caer_per_ray(
        scan.ranges, virtual, jnp.asarray(model.cap), scan.valid
    )
    weighed = -jax.vmap(caer)(jax.vmap(cast)(poses)) / model.scale
    return jnp.where(jnp.any(scan.valid), weighed, 0.0)  # CAER of nothing is inf


def _by_end_points(world, scan, poses, model):
    d = _distances(world, scan, poses)
    near = jnp.exp(-(d**2) / (2 * model.sigma_hit**2))
    p = model.z_hit * near + model.z_rand / scan.range_max
    if model.rule == "product":
        return jnp.sum(jnp.where(scan.echo[None], jnp.log(p), 0.0), axis=1)
    return jnp.log1p(jnp.sum(jnp.where(scan.echo[None], p**3, 0.0), axis=1))


def _distances(world, scan, poses):
    """From each particle's end points to the nearest wall [m], (particles, rays)."""
    points = scan.points
    if isinstance(world, PolygonMap):
        return world.distance_at(
            jax.vmap(geometry.transform_points, (0, None))(poses, points)
        )
    # In the grid's frame and in cells, x and y apart: one gather from the nearest cell.
    height, width = world.extent
    x, y = (world.to_cells(poses[:, :2])).T
    local = poses[:, 2] - world.origin[2]
    c, s = jnp.cos(local)[:, None], jnp.sin(local)[:, None]
    px, py = (points / world.resolution).T[:, None]
    column = jnp.floor(x[:, None] + c * px - s * py).astype(int)
    row = jnp.floor(y[:, None] + s * px + c * py).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    cell = jnp.clip(row, 0, height - 1) * world.cells.shape[1]
    cell += jnp.clip(column, 0, width - 1)
    return jnp.where(inside, world.distance.reshape(-1)[cell], jnp.inf)
