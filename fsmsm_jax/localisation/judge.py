"""What the map explains of a scan, and whether to believe the pose.

The plain CAER, Σ|r − v|, is the published judge, and it is the right one while the
map is true. In a changed building one moved cabinet costs as much as a wrong room.
So each ray is asked for its likelihood instead, a mixture that bounds its say:

    p = ½ exp(−(r − v)²/2σ²) + ½ exp(−d²/2σ²) + ε

r − v compares ranges, d is the end point's distance to the nearest wall (a grazing
ray may be a metre too long and still end on the right wall), and ε is what remains
for rays that fit neither: most if the ray ends in space that nobody has mapped, more
if it is too short (someone stood in the way) than if it is too long (it passed
through a wall). Near things are hit by many rays at once and move more often than
far walls, so rays count by the fourth root of their range.

`trust` is the verdict: the best pose must explain the scan, be fixed in all
directions, and leave every distinct rival behind.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fsmsm_jax import geometry
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap

__all__ = [
    "CLEAR_OF_WALL",
    "IN_THE_WAY",
    "ON_THE_WAY",
    "Evidence",
    "explain",
    "on_walls",
    "trust",
]

_SIGMA = 0.1  # [m]: map and sensor errors of a ray that the map does explain
_UNMAPPED, _TOO_SHORT, _TOO_LONG = 0.3, 0.1, 0.05  # ε, by what may have happened
_NO_ECHO_WEIGHT = 0.1  # glass, black things and sky make missing echoes poor witnesses
_THICKEST = 0.06  # [m]: walls drawn thicker than this are another place's walls
_EXPLAINED = 0.3  # [m]: a ray that reads or ends this close to the map fits it
_NEAR = 0.15  # [m]: σ of "on a wall" before the pose is polished
ON_THE_WAY = (0.3, 0.55, 0.8)  # where along a ray its free space is probed
IN_THE_WAY = 0.5  # weight of a wall at all probes of a ray; of one at its end, 1
CLEAR_OF_WALL = 0.75  # [m]: probes nearer to the end point would feel its wall
_LEAD = 0.15  # lead of a sure answer over its best rival [nats a ray]
_LEAD_PER_DOUBT = 0.75  # more of it per nat that the answer itself falls short
_MOST = 0.6  # share of the rays that a sure answer explains
_HARDLY_ANY = 0.05  # share of its rays that may pass through walls
_FIXED = 0.1  # [m]: standard deviation of the position of a sure answer


class Evidence(NamedTuple):
    """How well one pose explains one scan."""

    score: Float[Array, ""]
    """Mean log-likelihood of a valid ray."""
    explained: Float[Array, ""]
    """Share of the valid rays that the map explains."""
    blocked: Float[Array, ""]
    """Share of the valid rays that something unmapped cut short."""
    through: Float[Array, ""]
    """Share of the valid rays that passed through a mapped wall."""
    caer_per_ray: Float[Array, ""]
    """Mean |real − virtual range| where sensor and map both see something [m]."""


def explain(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    thickness: float | Float[Array, ""] = 0.0,
) -> Evidence:
    """How well the map explains the scan, seen from a pose [m, m, rad].

    Args:
        world: the map.
        scan: the real scan.
        pose: where the lidar may have been.
        thickness: how much too early virtual rays stop [m], as `polish_ranges` says.
    """
    virtual = raycast(world, pose, scan.bearings, scan.range_max)
    e = scan.ranges - virtual
    end = geometry.transform_points(pose, scan.points)
    d = world.distance_at(end)
    true_e = jnp.where(scan.echo, e - jnp.clip(thickness, 0.0, _THICKEST), e)
    by_range = jnp.exp(-0.5 * (true_e / _SIGMA) ** 2)
    by_end = jnp.exp(-0.5 * (d / _SIGMA) ** 2)
    rest = jnp.where(e < 0, _TOO_SHORT, _TOO_LONG)
    rest = jnp.where(world.unknown_at(end), _UNMAPPED, rest)
    log_p = jnp.where(
        scan.echo,
        jnp.log(0.5 * by_range + 0.5 * by_end + rest),
        _NO_ECHO_WEIGHT * jnp.log(by_range + 0.1),
    )
    fits = (jnp.abs(e) < _EXPLAINED) | (scan.echo & (d < _EXPLAINED))
    say = jnp.where(scan.valid, jnp.clip(scan.ranges, 0.3, 10.0) ** 0.25, 0.0)
    both = scan.echo & (virtual < scan.range_max)
    mean = lambda value, rays: (
        jnp.sum(jnp.where(rays, value, 0.0)) / jnp.maximum(jnp.sum(rays), 1)
    )
    return Evidence(
        score=jnp.sum(say * log_p) / jnp.maximum(jnp.sum(say), 1e-6),
        explained=mean(fits, scan.valid),
        blocked=mean(~fits & scan.echo & (e < 0), scan.valid),
        through=mean(~fits & scan.echo & (e > 0) & ~world.unknown_at(end), scan.valid),
        caer_per_ray=mean(jnp.abs(e), both),
    )


def on_walls(
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    pose: Float[Array, "3"],
    probes: tuple[float, ...] = ON_THE_WAY,
) -> Float[Array, ""]:
    """A first judgement, without casting: do rays end on walls, and on none before?

    Args:
        world: the map.
        scan: the real scan.
        pose: where the lidar may have been [m, m, rad].
        probes: where on a ray's way walls are looked for, in shares of it.

    Returns:
        At most 1: the weight of the echoes that end on walls, less half that of rays
        whose way leads along or through some.
    """
    say = jnp.clip(scan.ranges, 0.3, 10.0) ** 0.25
    say = say / jnp.maximum(jnp.sum(jnp.where(scan.echo, say, 0.0)), 1e-6)
    turned = pose[2] + scan.bearings
    along = scan.ranges[:, None] * jnp.stack([jnp.cos(turned), jnp.sin(turned)], axis=1)
    near = lambda share: jnp.exp(
        -0.5 * (world.distance_at(pose[None, :2] + share * along) / _NEAR) ** 2
    )
    score = jnp.where(scan.echo, near(1.0), 0.0)
    for share in probes:
        clear = scan.valid & ((1 - share) * scan.ranges > CLEAR_OF_WALL)
        score -= jnp.where(clear, IN_THE_WAY / len(probes) * near(share), 0.0)
    return jnp.sum(say * score)


def trust(
    scores: Float[Array, "candidates"], best: Evidence, covariance: Float[Array, "3 3"]
) -> Bool[Array, ""]:
    """Whether the first of the distinct candidates can be believed.

    Args:
        scores: of distinct candidates, best first [nats a ray].
        best: evidence for the first of them.
        covariance: of the best pose [m, m, rad].

    Returns:
        True if the best leads the runner-up by a margin, the wider the worse it
        explains the scan itself (people in the way are forgiven in part), if most
        rays are explained and hardly any passed through a wall, and if the position
        is known to better than 0.1 m. The numbers were set on the scans that
        `scripts/bench_localisation.py` reports, none held out: they are cautious,
        no guarantee.
    """
    lead = scores[0] - scores[1]
    doubt = jnp.maximum(-best.score - best.blocked, 0.0)
    fixed = jnp.sqrt(covariance[0, 0] + covariance[1, 1]) < _FIXED
    fits = (best.explained > _MOST) & (best.through < _HARDLY_ANY)
    return (lead > _LEAD + _LEAD_PER_DOUBT * doubt) & fits & fixed
