r"""Where the lidar sits in the robot, from driving about in a known map.

The odometry says how the base moved, the scans say where the lidar was, and what joins
them is the mounting (hand-eye calibration). Driving straight shows the yaw: the lidar
sees itself move along the robot's nose. Turning shows x and y: the lidar swings about
the wheels' axle. A robot that never turns cannot tell where its lidar sits.

Odometry is good for a metre and not for a hundred, so the log is cut into windows of
some scans. Each has a base pose of its own; within it, ray n of scan k was shot from

$$T_w \oplus O_k \oplus v_k (\delta + \varsigma n / N) \oplus m ,$$

odometry O_k from the window's middle, twist v_k per scan period, and mounting m. All
rays of all windows then fit the map at once, ranges against `raycast`'s exact
derivative (`separable`). What else is not quite as stated is estimated along: the
delay δ of the scans' stamps against the odometry's, scales of travel and turn, the
spacing of the rays, the thickness of drawn walls. On the log of a TurtleBot 4 the first
of these matters most: its scans are some 0.1 s older than their stamps say, and
a mounting found without δ is centimetres off.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fit import descend_end_points, fit_ranges
from fsmsm_jax.alignment.residuals import range_residuals
from fsmsm_jax.calibration.inputs import check, determined, finite, thinned
from fsmsm_jax.calibration.separable import Linearised, solve
from fsmsm_jax.sensing import Scan
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["Mounting", "MountingConfig", "mounting"]

_DESCENT = (0.4, 0.3, 0.2, 0.2, 0.2)  # kernel scales [m] that settle a tracked pose
_POLISH, _REACH = 6, 0.3  # range fits of a tracked pose, and how far they may go [m]
_SIGMA = 0.15  # [m] of a residual while the mounting is still wrong
_SPREAD = (1.0, 1.0, 1.0)  # [m, m, rad] of the guess: robots are no larger


class MountingConfig(eqx.Module):
    """How far to trust odometry and sensor; a deviation of 0 means exactly known."""

    sweep: ScalarLike = 0.0
    """Scan periods from the first ray of a scan to its last: 1 for a spinning sensor,
    −1 if its rays are listed against their order in time, 0 if all are shot at once."""
    delay: ScalarLike = 1.0
    """Deviation of a scan's time from its stamp [scan periods]."""
    stretch: ScalarLike = 0.02
    """Deviation of the rays' true spacing from the stated one [share], about the ray
    that is shot first. Some drivers spread 360° of rays over 359°."""
    travel: ScalarLike = 0.03
    """Deviation of the odometry's metre [share]."""
    turn: ScalarLike = 0.03
    """Deviation of the odometry's radian [share]."""
    thickness: ScalarLike = 0.05
    """Deviation of where walls are drawn [m]; grids only."""
    window: int = eqx.field(static=True, default=20)
    """Scans over which odometry is taken as exact but for its scales."""
    rays: int = eqx.field(static=True, default=120)
    """About how many rays of a scan to use."""
    steps: int = eqx.field(static=True, default=20)
    """Gauss-Newton steps."""


class Mounting(NamedTuple):
    """Where the lidar sits."""

    pose_base_lidar: Float[Array, "3"]
    """Pose [x, y, θ] of the lidar in the robot's base [m, m, rad]."""
    covariance: Float[Array, "3 3"]
    """Its covariance over the windows [m, m, rad]²."""
    std: Float[Array, "3"]
    """Its standard deviations [m, m, rad]; about 1 for what the log does not tell."""
    determined: Bool[Array, "3"]
    """Whether the log tells x, y, θ. Without turns it does not tell x and y."""
    delay: Float[Array, ""]
    """When a scan's first ray was shot, after its stamp [scan periods]."""
    stretch: Float[Array, ""]
    """By how much the rays are spaced wider than stated [share]."""
    scales: Float[Array, "2"]
    """By how much farther the robot went and turned than odometry says [share]."""
    thickness: Float[Array, ""]
    """By how much drawn walls stand nearer than real ones [m]; 0 on polygons."""
    poses_map_lidar: Float[Array, "scans 3"]
    """The tracked poses of the lidar in the map, to look at [m, m, rad]."""
    residual: Float[Array, ""]
    """Standard deviation of a ray's residual, by the median [m]."""
    converged: Bool[Array, ""]
    """Whether the last step was small, against the deviations."""


def mounting(
    world: OccupancyGrid | PolygonMap,
    scans: Scan,
    odometry: Sequence | np.ndarray | Array,
    start: Sequence | np.ndarray | Array,
    guess: Sequence | np.ndarray | Array = (0.0, 0.0, 0.0),
    config: MountingConfig = MountingConfig(),
) -> Mounting:
    """The lidar's pose in the robot, from scans, odometry and a map.

    Args:
        world: the map.
        scans: scans in order of time, stacked along a leading axis, at about equal
            intervals.
        odometry: (scans, 3) poses of the base in the odometry's frame [m, m, rad], at
            the scans' stamps.
        start: pose [x, y, θ] of the *lidar* in the map at the first scan, within some
            decimetres, say `localise`'s.
        guess: the mounting [x, y, θ] to start from; 20° may be missing.
        config: what is known of the sensor and of the odometry.

    Returns:
        The mounting, and what was estimated along with it.

    Raises:
        ValueError: the scans are not stacked, are fewer than three windows, or one has
            fewer than 10 echoes; odometry, start or guess is of a wrong shape or not
            finite; the window is shorter than 3 scans.

    Reference:
        After A. Censi, A. Franchi, L. Marchionni and G. Oriolo, "Simultaneous
        calibration of odometry and sensor parameters for mobile robots", IEEE T-RO
        2013, which fits scan-matched motions; here the ranges themselves are fitted.

    Note:
        The bearings' zero is the sensor's own: whether its rays leave it a degree to
        the left or the whole sensor is mounted so, nobody can tell. Not differentiable.
    """
    if config.window < 3:
        raise ValueError(f"a window takes at least 3 scans, not {config.window}")
    odometry = check(scans, odometry, 3 * config.window, "odometry")
    start, guess = finite(start, (3,), "start"), finite(guess, (3,), "guess")
    config = jax.tree.map(lambda number: jnp.asarray(number, float), config)
    return _mounting(world, scans, odometry, start, guess, config)


@jax.jit
def _mounting(world, scans, odometry, start, guess, config):
    rays = scans.ranges.shape[1]
    order = jnp.broadcast_to(jnp.arange(rays) / rays, scans.ranges.shape)
    last = config.sweep < 0
    zero = jnp.where(last, scans.bearings[:, -1:], scans.bearings[:, :1])
    every = max(1, rays // config.rays)
    order, scans = order[:, ::every], thinned(scans, config.rays)
    tracked = _track(world, scans, odometry, start, guess)

    count = len(odometry) // config.window * config.window
    cut = lambda a: a[:count].reshape(-1, config.window, *a.shape[1:])
    middle = config.window // 2
    step = jax.vmap(geometry.between)(odometry[:-1], odometry[1:])
    twist = (jnp.pad(step, ((1, 0), (0, 0))) + jnp.pad(step, ((0, 1), (0, 0)))) / 2
    steps = cut(jnp.pad(step, ((1, 0), (0, 0))))  # into each scan, from the one before
    items = jax.tree.map(cut, (scans, scans.bearings - zero, order, twist)) + (steps,)
    to_base = lambda pose: geometry.compose(pose, geometry.inverse(guess))
    bases = jax.vmap(to_base)(cut(tracked)[:, middle])

    def scan_poses(base, shared, steps):
        """Base poses of a window's scans, outwards from its middle."""
        scaled = steps * (1 + shared[jnp.array([5, 5, 6])])[None]

        def onward(pose, step):
            pose = geometry.compose(pose, step)
            return pose, pose

        back = jax.vmap(geometry.inverse)(scaled[1 : middle + 1])
        _, after = jax.lax.scan(onward, base, scaled[middle + 1 :])
        _, before = jax.lax.scan(onward, base, back, reverse=True)
        return jnp.concatenate([before, base[None], after])

    def linearise(item, base, shared):
        scans, turned, order, twist, steps = item
        unknowns = jnp.concatenate([base, shared])
        poses_of = lambda u: scan_poses(u[:3], u[3:], steps)
        moved = jax.jacfwd(poses_of)(unknowns)

        def ray(ranges, bearing, turned, valid, echo, limit, order, pose, moved, twist):
            def shot(pose, shared):
                when = shared[3] + config.sweep * order
                there = geometry.compose(pose, when * twist)
                seen = geometry.compose(there, shared[:3])
                return seen.at[2].add(shared[4] * turned)

            by_pose, by_shared = jax.jacfwd(shot, (0, 1))(pose, shared)
            one = Scan(ranges[None], bearing[None], valid[None], echo[None], limit)
            e, J, known = range_residuals(world, one, shot(pose, shared), shared[7])
            chain = (by_pose @ moved).at[:, 3:].add(by_shared)
            J_all = (J[0, :3] @ chain).at[-1].add(J[0, 3])
            return e[0] / J[0, 3], J_all / J[0, 3], known[0]

        along = jax.vmap(ray, (0, 0, 0, 0, 0, None, 0, None, None, None))
        e, J, known = jax.vmap(along)(
            scans.ranges,
            scans.bearings,
            turned,
            scans.valid,
            scans.echo,
            scans.range_max,
            order,
            scan_poses(base, shared, steps),
            moved,
            twist,
        )
        return Linearised(e.ravel(), J.reshape(e.size, -1), known.ravel())

    thickness = config.thickness if isinstance(world, OccupancyGrid) else 0.0
    along = (config.delay, config.stretch, config.travel, config.turn, thickness)
    spread = jnp.stack([jnp.asarray(s, guess.dtype) for s in (*_SPREAD, *along)])
    first = jnp.concatenate([guess, jnp.zeros(5, guess.dtype)])
    found = solve(linearise, items, bases, first, spread, _SIGMA, config.steps)
    covariance, shared = found.covariance[:3, :3], found.shared
    return Mounting(
        pose_base_lidar=shared[:3].at[2].set(geometry.wrap(shared[2])),
        covariance=covariance,
        std=jnp.sqrt(jnp.diag(covariance)),
        determined=determined(covariance, spread[:3]),
        delay=shared[3],
        stretch=shared[4],
        scales=shared[5:7],
        thickness=shared[7],
        poses_map_lidar=tracked,
        residual=found.sigma,
        converged=found.converged,
    )


def _track(world, scans, odometry, start, guess):
    """Poses of the lidar in the map, scan after scan, by odometry and matching."""

    def step(state, args):
        pose, before = state
        scan, now = args
        ahead = geometry.between(
            geometry.compose(before, guess), geometry.compose(now, guess)
        )
        pose = geometry.compose(pose, ahead)
        kernels = jnp.asarray(_DESCENT, pose.dtype)
        pose = descend_end_points(world, scan, pose, kernels)
        pose, _ = fit_ranges(world, scan, pose, _POLISH, _REACH)
        return (pose, now), pose

    return jax.lax.scan(step, (start, odometry[0]), (scans, odometry))[1]
