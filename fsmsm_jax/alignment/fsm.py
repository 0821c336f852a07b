r"""FSM: scan against scan, where the first scan is the world.

No map, no correspondences: what the reference scan has seen is a polygon, virtual scans
are cast in it, and the scan is matched with those as with a map's. The pose that comes
out is how far the sensor has moved in between. Two ways lead there; the type of the
config says which, as for `match`:

- `FastConfig`: Fourier into the basin and Gauss-Newton to the end, with what a scan
  differs in from a map taken seriously. Its walls are noisy, so they are smoothed for
  the casts and both scans' end points fitted to each other in the end (`views`). It
  ends where sight ended, so rays that pass there have no vote (`seen_space`).
- `FsmsmConfig.scan_to_scan()`: the thesis's FSM, in whose world the end points are
  joined all around, for panoramic scans.

The noise of one scan is in all rays that meet its walls. So the bound is not that of a
map: with equal sensors its variance is twice as large.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax.alignment.blocks import as_batch, first, in_blocks
from fsmsm_jax.alignment.fast import FastConfig, approach
from fsmsm_jax.alignment.first_estimate import check_scans, checked, strayed
from fsmsm_jax.alignment.fsmsm import fsmsm
from fsmsm_jax.alignment.fsmsm_config import Alignment, FsmsmConfig
from fsmsm_jax.alignment.match import Match
from fsmsm_jax.alignment.views import View, fit_views, view_covariance
from fsmsm_jax.sensing import Scan, closed_outline, panorama, raycast, seen_space

__all__ = ["fast_fsm", "fsm", "match_scans", "match_scans_batch"]

_AGREEING, _NOISES = 0.1, 4.0  # [m], or so many σ of the difference: off, or not
_MOST = 0.8  # share of the common rays that agree if the answer is right
_COMMON = 0.25  # share of the echoes that must be common
_EVEN = 0.02  # of the rays: a sensor at rest agrees with its guess as well as ever


def fast_fsm(
    reference: View, view: View, guess: Float[Array, "3"], config: FastConfig
) -> Float[Array, "3"]:
    """The pose of one scan in the frame of another, given about; one pair.

    Args:
        reference: the scan that is the world.
        view: the scan that is placed in it, with as many rays in its panorama.
        guess: estimate of that pose [m, m, rad].
        config: settings.

    Returns:
        The pose, always finite. Pure and of fixed length, for `vmap` and `jit`.
    """
    world = seen_space(reference.panorama, reference.walls)
    found = approach(world, view.panorama, guess, config)
    return fit_views(reference, view, found, config.finish, config.box[0])


def match_scans(
    reference: Scan,
    scan: Scan,
    guess: Sequence | np.ndarray | Array = (0.0, 0.0, 0.0),
    config: FastConfig | FsmsmConfig = FastConfig(stray=1.5),
    *,
    rays: int = 360,
    key: PRNGKeyArray | None = None,
) -> Match:
    """How has the sensor moved from one scan to the next?

    Args:
        reference: the scan that was taken first; of any field of view.
        scan: the one taken then, by a sensor of the same `range_max`.
        guess: about where it was taken in the frame of the reference [m, m, rad]: from
            odometry, from the last motion, or where the first was. The truth should lie
            within the config's `box` around it.
        config: settings, and with them the method: a `FastConfig`, or
            `FsmsmConfig.scan_to_scan()` for the thesis's. Answers may stray 1.5 boxes:
            the corner of a box that is turned by 45°, as the sensor may be.
        rays: of the panoramas; about as many as the sensor's per turn.
        key: for FSM's fresh starts.

    Returns:
        The pose of `scan`'s sensor in the frame of the reference's, its covariance, and
        what to think of it. The CAER is that of the rays that both have seen. Where
        less than a quarter of the echoes is common, less than 80 % of these agree (to
        0.1 m, or four times the noise), or they agree less than at the guess,
        `converged` is False and the guess is given back, with the covariance of a pose
        anywhere in the box.

    Raises:
        ValueError: the guess is not three finite numbers; a scan has fewer than 10
            echoes; the sensors differ in `range_max`; fewer than 8 rays are asked for;
            rays are missing and the method needs all.

    Example:
        >>> from fsmsm_jax import PolygonMap
        >>> room = PolygonMap.from_outlines([[1, 1], [5, 1], [5, 4], [2, 4]])
        >>> bearings = jnp.linspace(-2.0, 2.0, 230)  # 229° of the room
        >>> take = lambda *pose: Scan.from_bearings(
        ...     raycast(room, jnp.array(pose), bearings), bearings
        ... )
        >>> found = match_scans(take(3.0, 2.0, 0.0), take(3.1, 2.1, 0.2))
        >>> [round(v, 2) for v in found.pose.tolist()], bool(found.converged)
        ([0.1, 0.1, 0.2], True)

    Reference:
        FSM, Algorithm XXIV of the thesis. Veils, the fit of both scans to each other,
        guard and covariance are ours.
    """
    if np.ndim(reference.ranges) != 1 or np.ndim(scan.ranges) != 1:
        raise ValueError(
            "expected two scans with (rays,) ranges, got shapes "
            f"{np.shape(reference.ranges)} and {np.shape(scan.ranges)}; "
            "match_scans takes one pair, match_scans_batch many"
        )
    if np.shape(guess) != (3,):
        raise ValueError(
            f"a guess is [x, y, θ], three numbers [m, m, rad]; got {np.shape(guess)}"
        )
    pair = as_batch(reference), as_batch(scan)
    guesses = np.asarray(guess, float)[None]
    return first(match_scans_batch(*pair, guesses, config, rays=rays, key=key))


def match_scans_batch(
    references: Scan,
    scans: Scan,
    guesses: Sequence | np.ndarray | Array,
    config: FastConfig | FsmsmConfig = FastConfig(stray=1.5),
    *,
    rays: int = 360,
    key: PRNGKeyArray | None = None,
) -> Match:
    """`match_scans` for many pairs in one call.

    Args:
        references: scans stacked along a leading axis.
        scans: as many, of one sensor.
        guesses: (pairs, 3), each as in `match_scans`.
        config: as in `match_scans`.
        rays: as in `match_scans`.
        key: as in `match_scans`; each pair draws from a key of its own.

    Returns:
        A `Match` whose arrays have the same leading axis.

    Raises:
        ValueError: as `match_scans`, for any pair; there are not as many of each.
    """
    guesses = checked(None, scans, guesses, rays)
    check_scans(references)
    if len(references.ranges) != len(guesses):
        raise ValueError(
            f"expected one reference a scan ({len(guesses)}), got "
            f"{len(references.ranges)}"
        )
    limits = float(references.range_max[0]), float(scans.range_max[0])
    if limits[0] != limits[1]:
        raise ValueError(
            f"the scans must end at one range_max, got {limits[0]:g} and "
            f"{limits[1]:g} m; give both the smaller"
        )
    found = None
    if isinstance(config, FsmsmConfig):
        missing = int(_missing(references, scans, rays))
        if missing:
            raise ValueError(
                f"the thesis's FSM needs echoes all around, but {missing} of {rays} "
                "rays of a scan are without; FastConfig() can do without them"
            )
        key = jax.random.key(0) if key is None else key
        found = fsm(references, scans, guesses, config, rays, key)
    jobs = references, scans, guesses, found
    run = lambda block: _match(block, config, rays)
    return in_blocks(run, jobs, len(guesses))


@jax.jit(static_argnums=2)
def _missing(references, scans, rays):
    """The largest number of rays without an echo in any panorama."""
    each = jax.vmap(lambda scan: jnp.sum(~panorama(scan, rays).echo))
    return jnp.maximum(jnp.max(each(references)), jnp.max(each(scans)))


@jax.jit(static_argnums=4)
def fsm(
    references: Scan,
    scans: Scan,
    guesses: Float[Array, "pairs 3"],
    config: FsmsmConfig,
    rays: int,
    key: PRNGKeyArray,
) -> Alignment:
    """The thesis's FSM: `fsmsm` in the polygons of the references; a batch.

    Args:
        references: scans stacked along a leading axis, echoes all around.
        scans: as many.
        guesses: estimates of their poses in the frames of the references [m, m, rad].
        config: settings, such as `FsmsmConfig.scan_to_scan()`.
        rays: of the panoramas; static.
        key: for fresh starts.

    Returns:
        What `fsmsm` returns, without the verdict of `match_scans`.

    Reference:
        Algorithm XXIV of the thesis.
    """
    around = jax.vmap(lambda scan: panorama(scan, rays))
    worlds = jax.vmap(closed_outline)(around(references))
    return fsmsm(
        worlds,
        around(scans).ranges,
        guesses,
        config,
        range_max=scans.range_max[0],
        key=key,
    )


@jax.jit(static_argnums=2)
def _match(jobs, config, rays):
    """Pose, verdict and covariance of a block of pairs."""

    def one(job):
        reference, scan, guess, found = job
        reference, view = View.of(reference, rays), View.of(scan, rays)
        if isinstance(config, FastConfig):
            pose = fast_fsm(reference, view, guess, config)
            steps, scans = (
                1 + config.looks + config.finish,
                1 + config.kept * config.looks,
            )
            learned = ~strayed(config, pose, guess)
        else:
            pose, learned = found.pose, found.converged
            steps, scans = found.steps, found.scans
        compare = lambda pose: _compare(reference, view, pose)
        caers, agreements, common = jax.vmap(compare)(jnp.stack([guess, pose]))
        learned &= (common[1] >= _COMMON) & (agreements[1] >= _MOST)
        # Not if the guess, from which no less is common, agrees better already.
        gained = agreements[1] - agreements[0] >= -_EVEN
        learned &= gained | (common[1] > common[0])
        spread = view_covariance(reference, view, pose)
        half = jnp.stack([config.box[0], *config.box]).astype(pose.dtype)
        chosen = learned.astype(int)
        return Match(
            pose=jnp.where(learned, pose, guess),
            covariance=jnp.where(learned, spread, jnp.diag(half**2 / 3)),
            caer_per_ray=caers[chosen],
            caer_before=caers[0],
            agreement=agreements[chosen],
            converged=learned,
            iterations=jnp.asarray(steps, int),
            scans=jnp.asarray(scans, int),
        )

    return jax.vmap(one)(jobs)


def _compare(reference, view, pose):
    """Of the rays that both know: CAER, share in agreement, and share of the echoes."""
    scan, noise = view.panorama, jnp.hypot(reference.walls.noise, view.walls.noise)
    world = seen_space(reference.panorama, reference.walls)
    virtual = raycast(world, pose, scan.bearings, scan.range_max)
    common = scan.echo & (virtual < scan.range_max)
    off = jnp.abs(scan.ranges - virtual)
    count = jnp.maximum(jnp.sum(common), 1)
    agreeing = off <= jnp.maximum(_AGREEING, _NOISES * noise)
    return (
        jnp.sum(jnp.where(common, off, 0.0)) / count,
        jnp.sum(common & agreeing) / count,
        jnp.sum(common) / jnp.maximum(jnp.sum(scan.echo), 1),
    )
