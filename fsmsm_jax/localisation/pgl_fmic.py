r"""Where am I, by pictures: passive global localisation with Fourier-Mellin (PGL-FMIC).

Strew hypotheses over the map's free space, see from each what the lidar would see, and
compare *pictures* of the two scans, not ranges. The magnitude of a picture's spectrum
does not change when what it shows is shifted, so each hypothesis learns how it is
turned before it knows where it is (`alignment.fmi_spomf`):

1. **draw** |H| poses in free space;
2. **turn**: picture both scans, register them, turn the hypothesis by ξ; how alike the
   pictures are is its similarity w; a scale outside a gate refuses it;
3. **move**: go to where the scan was taken, in steps, each with a fresh virtual scan;
4. the hypothesis with the highest w is the answer.

The thesis's words are kept, not all its choices. What `PglFmicConfig` does unless told
otherwise, and `PUBLISHED` does not:

- hypotheses move by the shift of the pictures, not by centroids (`scan_offset`);
- only the best are moved, and those whose pictures then agree best are turned and moved
  again. From where the scan was taken the right one sees the same picture, and its w
  jumps above all others; from a metre or two away, often, it does not yet;
- hypotheses keep their distance from each other: two in one place know as much as one.

Both draw pictures to one scale. Each scaled to its own content, as in the thesis, they
hide how large a room is, and the scale that is found says little.

Reference: the thesis's chapter 5.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, ScalarLike

from fsmsm_jax import geometry
from fsmsm_jax.alignment.fmi_spomf import FmiConfig, image_spectra, rotation_and_scale
from fsmsm_jax.localisation.clouds import init_uniform
from fsmsm_jax.localisation.particles import ParticleConfig
from fsmsm_jax.localisation.scan_offset import (
    outline_centroid,
    picture_phases,
    picture_shift,
)
from fsmsm_jax.resampling import Kld
from fsmsm_jax.sensing.lidar import Scan
from fsmsm_jax.sensing.outline_image import outline_image
from fsmsm_jax.sensing.panorama import panorama
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap

__all__ = ["PUBLISHED", "Finalists", "PglFmic", "PglFmicConfig", "pgl_fmic"]

_WIDER = 2.5  # sides of a picture, in ranges of the farthest end point: room to fade
_FEWER = 4  # of the finalists of a round, one in so many goes through to the next
_FEWEST_ECHOES = 20
_WIDEST_GAP = 0.5  # [rad] without information that a neighbour's range may fill
_TOGETHER = 1  # pictures registered in step: one fits the cache of a CPU's core


class PglFmicConfig(eqx.Module):
    """How pictures are made and hypotheses are judged; |H| is the caller's."""

    size: int = eqx.field(static=True, default=128)
    """N_G: pixels along a side of a picture; the thesis has 256."""
    rays: int = eqx.field(static=True, default=720)
    """N_s: rays of a scan, as it is pictured."""
    move: str = eqx.field(static=True, default="shift")
    """By what a hypothesis is moved: the pictures' "shift", or "centroid"."""
    steps: int = eqx.field(static=True, default=2)
    """I_T: moves in each round; the thesis takes 10, by centroids."""
    smallest_scale: ScalarLike = 0.9
    """σ below which a hypothesis is refused; the true one is 1."""
    largest_scale: ScalarLike = 1.2
    """σ above which a hypothesis is refused."""
    registration: FmiConfig = FmiConfig(
        radii=64, candidates=1, kept=1, largest_scale=1.2
    )
    """How pictures are compared; scales above its `largest_scale` are not sought."""
    tries: int = eqx.field(static=True, default=8)
    """Poses drawn for each hypothesis; those that keep most distance stay."""
    finalists: int = eqx.field(static=True, default=32)
    """Hypotheses that are moved in the first round; in each later one, a quarter."""
    rounds: int = eqx.field(static=True, default=2)
    """How often: turn, move."""
    threshold: ScalarLike = 0.4
    """Similarity from which an answer counts as converged."""

    def __check_init__(self):
        """Refuse sizes that nothing can be drawn or chosen with."""
        if self.size < 32 or self.rays < 8:
            raise ValueError(
                "expected pictures of at least 32 pixels and scans of at least 8 rays, "
                f"got {self.size} and {self.rays}"
            )
        if min(self.steps, self.tries, self.finalists, self.rounds) < 1:
            raise ValueError(
                "steps, tries, finalists and rounds must be at least 1, got "
                f"{self.steps}, {self.tries}, {self.finalists}, {self.rounds}"
            )
        if self.move not in ("shift", "centroid"):
            raise ValueError(f"move must be 'shift' or 'centroid', got {self.move!r}")


PUBLISHED = PglFmicConfig(
    size=256,
    move="centroid",
    steps=10,
    registration=FmiConfig(candidates=1, kept=1),
    tries=1,
    finalists=1,
    rounds=1,
)
"""The thesis's: hypotheses drawn without regard to each other, scales up to 2 looked
at and then refused by the gate, one round, centroids."""


class Finalists(NamedTuple):
    """The hypotheses of the last round, moved."""

    poses: Float[Array, "finalists 3"]
    """Of the lidar in the map [m, m, rad]."""
    similarity: Float[Array, "finalists"]
    """w of the last round; −1 if a scale, in any round, was outside the gate."""


class PglFmic(NamedTuple):
    """What one scan says about where the lidar is, and how each hypothesis fared."""

    pose: Float[Array, "3"]
    """Best pose of the lidar in the map [m, m, rad]."""
    similarity: Float[Array, ""]
    """w in [0, 1] of the best; 0 if every hypothesis was refused."""
    converged: Bool[Array, ""]
    """Whether one passed the gate and w reaches the threshold; if not, believe none."""
    hypotheses: Float[Array, "hypotheses 3"]
    """As drawn, each turned by its ξ [m, m, rad]."""
    scale: Float[Array, "hypotheses"]
    """σ of each."""
    similarities: Float[Array, "hypotheses"]
    """w of each, in the first round."""
    finalists: Finalists
    """Those that were moved."""


def pgl_fmic(
    key: PRNGKeyArray,
    world: OccupancyGrid | PolygonMap,
    scan: Scan,
    hypotheses: int,
    config: PglFmicConfig = PglFmicConfig(),
) -> PglFmic:
    """Where in the map was this panoramic scan taken? By pictures, without an atlas.

    Args:
        key: of the draw of hypotheses.
        world: the map.
        scan: one scan of (nearly) the full circle.
        hypotheses: |H|; one for each 3 m² or so of free space.
        config: settings.

    Returns:
        The best pose and what to think of it; arrays on the device.

    Raises:
        ValueError: `world` is no map, or has no free cell; fewer than one hypothesis;
            the scan is not one row of ranges, has a gap of more than 0.5 rad without
            information, or fewer than 20 echoes.

    Example:
        >>> import fsmsm_jax as fj
        >>> world = fj.buildings.office(seed=0)
        >>> pgl_fmic(jax.random.key(0), world, scan, 200).pose  # doctest: +SKIP

    Reference:
        The algorithms pgl_fmic, fmic, orientation_estimation and position_estimation
        of the thesis's chapter 5.

    Note:
        Some milliseconds a hypothesis; `localise` is faster and more exact.
    """
    _check(world, scan, hypotheses)
    return _pgl_fmic(key, world, scan, hypotheses, config)


def _check(world, scan, hypotheses):
    if not isinstance(world, OccupancyGrid | PolygonMap):
        raise ValueError(
            f"expected an OccupancyGrid or a PolygonMap, got {type(world).__name__}"
        )
    if isinstance(world, OccupancyGrid) and not np.asarray(world.free).any():
        raise ValueError("the map has no free cell; check its thresholds")
    if hypotheses < 1:
        raise ValueError(f"expected at least 1 hypothesis, got {hypotheses}")
    if np.ndim(scan.ranges) != 1:
        raise ValueError(
            f"expected (rays,) ranges, got shape {np.shape(scan.ranges)}; "
            "pgl_fmic takes one scan"
        )
    echoes = int(np.sum(np.asarray(scan.echo)))
    if echoes < _FEWEST_ECHOES:
        raise ValueError(
            f"{echoes} of {scan.echo.size} rays met something, a picture needs "
            f"{_FEWEST_ECHOES}; check range_max and units"
        )
    bearings = np.asarray(scan.bearings)[np.asarray(scan.valid)]
    around = np.sort(np.mod(bearings, 2 * np.pi))
    gap = np.max(np.diff(around, append=around[0] + 2 * np.pi))
    if gap > _WIDEST_GAP:
        raise ValueError(
            f"the scan says nothing over {gap:.2f} rad, at most {_WIDEST_GAP} is "
            "allowed: pictures of partial views do not turn into each other. "
            "localise takes any field of view"
        )


@partial(jax.jit, static_argnums=3)
def _pgl_fmic(key, world, scan, hypotheses, config):
    real = panorama(scan, config.rays)
    ranges = _filled(real)
    extent = _WIDER * jnp.max(ranges)
    picture = lambda r: outline_image(r, config.size, extent)
    reference = image_spectra(picture(ranges), config.registration)

    cast = jax.vmap(lambda pose: raycast(world, pose, real.bearings, real.range_max))

    def turned(poses):
        """Orientation estimation: poses, their scales σ and similarities w."""
        look = lambda r: rotation_and_scale(reference, picture(r), config.registration)
        found = jax.lax.map(look, cast(poses), batch_size=_TOGETHER)
        heading = geometry.wrap(poses[:, 2] + found.rotation)
        # The thesis's σ is what makes s as large as r.
        return poses.at[:, 2].set(heading), 1 / found.scale, found.similarity

    centroid = outline_centroid(ranges, real.bearings)
    phases = picture_phases(picture(ranges))

    def way(args):
        """From a scan and its w: to where the real one was taken, and a better w."""
        r, w = args
        if config.move == "centroid":
            return outline_centroid(r, real.bearings) - centroid, w
        shift, peak = picture_shift(phases, picture_phases(picture(r)))
        return shift * (extent / config.size), peak

    def moved(poses, w):
        """Position estimation: poses, and their similarities w before the last step."""

        def step(state, _):
            poses, w = state
            xy, w = jax.lax.map(way, (cast(poses), w), batch_size=_TOGETHER)
            way_there = jnp.pad(xy, ((0, 0), (0, 1)))
            return (jax.vmap(geometry.compose)(poses, way_there), w), None

        return jax.lax.scan(step, (poses, w), length=config.steps)[0]

    poses, scale, w = first = turned(_strewn(key, world, hypotheses, config.tries))
    passed = jnp.ones(hypotheses, bool)
    for k in range(config.rounds):
        if k > 0:
            poses, scale, w = turned(poses)
        gate = (scale >= config.smallest_scale) & (scale <= config.largest_scale)
        passed = passed & gate
        count = min(max(1, config.finalists // _FEWER**k), len(poses))
        _, best = jax.lax.top_k(jnp.where(passed, w, -1.0), count)
        passed = passed[best]
        poses, w = moved(poses[best], w[best])
    w = jnp.where(passed, w, -1.0)
    winner = jnp.argmax(w)
    similarity = jnp.clip(w[winner], 0.0, 1.0)
    converged = passed[winner] & (similarity >= config.threshold)
    return PglFmic(poses[winner], similarity, converged, *first, Finalists(poses, w))


def _filled(real: Scan):
    """Ranges, those of rays without information taken from the ray before."""
    index = jnp.arange(2 * real.valid.size)
    last = jax.lax.cummax(jnp.where(jnp.tile(real.valid, 2), index, -1))
    return real.ranges[last[real.valid.size :] % real.valid.size]


def _strewn(key, world, count, tries):
    """Random poses in free space, each the farthest of many from all before it."""
    room = ParticleConfig(kld=Kld(fewest=1, most=count * tries))
    drawn = init_uniform(key, world, room).poses
    if tries == 1:
        return drawn

    def add(nearest, _):
        farthest = jnp.argmax(nearest)
        dx, dy = (drawn[:, :2] - drawn[farthest, :2][None]).T
        return jnp.minimum(nearest, dx**2 + dy**2), farthest

    start = jnp.full(len(drawn), jnp.inf, drawn.dtype)
    return drawn[jax.lax.scan(add, start, length=count)[1]]
