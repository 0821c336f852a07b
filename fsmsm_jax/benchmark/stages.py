"""What is measured: each stage of the way from a ray to a pose, on an office floor.

The floor is `buildings.office(0)`, 1 000 m², so that everybody has it; the scans have
360 rays over 270°, 2 cm of noise, and a fifth of the rays blocked. A `Stage` is work to
be timed and how its seconds are told: so much of something a second, or milliseconds.

Stages that are about one robot (a match, a query, a step) are told as the time that the
robot waits; those that are about many of something (rays, headings, scans, updates) as
a rate. The many are more where there is a GPU to fill.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fsmsm_jax.alignment.match import match as match_scan
from fsmsm_jax.alignment.orientation import fourier_mellin
from fsmsm_jax.benchmark.clock import clock
from fsmsm_jax.benchmark.metric import Metric
from fsmsm_jax.localisation import particles, tracker
from fsmsm_jax.localisation.atlas import ScanAtlas
from fsmsm_jax.localisation.atlas_build import build_atlas
from fsmsm_jax.localisation.clouds import init_at
from fsmsm_jax.localisation.search import localise, localise_batch
from fsmsm_jax.resampling import Kld
from fsmsm_jax.sensing.lidar import Lidar, Scan
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.slam.filter import SlamConfig, init, run
from fsmsm_jax.slam.simulate import Circle, scatter, simulate
from fsmsm_jax.slam.vehicle import Car
from fsmsm_jax.world.buildings import office
from fsmsm_jax.world.occupancy import OccupancyGrid

__all__ = [
    "STAGES",
    "Amounts",
    "Scene",
    "Stage",
    "measure",
    "random_poses",
    "rays_from",
    "simulated_scans",
]

_WORSE = 1.5  # share of the baseline's ratio to the reference that may be noise
_CLEARANCE = 0.4  # [m] that sensors keep from walls
_FILTER = 100  # particles of SLAM, and landmarks of each


class Amounts(NamedTuple):
    """How many at a time."""

    poses: int
    """Scans that are cast together, and scans turned against each other."""
    scans: int
    """Of a batch."""
    particles: int

    @classmethod
    def of_device(cls) -> "Amounts":
        """What fills two cores, or a GPU."""
        if jax.default_backend() == "cpu":
            return cls(poses=4096, scans=16, particles=10_000)
        return cls(poses=65_536, scans=256, particles=1_000_000)


class Scene:
    """A building, and scans taken in it; what is dear is made when it is asked for."""

    def __init__(self, amounts: Amounts):
        self.amounts = amounts
        self.world: OccupancyGrid = office(seed=0)

    @functools.cached_property
    def scans(self) -> tuple[Scan, Float[Array, "scans 3"]]:
        """A batch of scans, stacked, and the poses they were taken from."""
        return simulated_scans(self.world, self.amounts.scans)

    @functools.cached_property
    def scan(self) -> tuple[Scan, Float[Array, "3"]]:
        """One of them."""
        return jax.tree.map(lambda a: a[0], self.scans)

    @functools.cached_property
    def atlas(self) -> ScanAtlas:
        """Of the building, by default settings."""
        return jax.block_until_ready(build_atlas(self.world))


class Stage(NamedTuple):
    """Work to be timed, and how its seconds are told."""

    work: Callable[[], object]
    unit: str
    amount: float | None = None
    """How many `unit`s one call is worth, told per second; None: told in ms."""

    def told(self, seconds: float) -> float:
        """Seconds of a call in the stage's unit."""
        return 1e3 * seconds if self.amount is None else self.amount / seconds


def random_poses(
    world: OccupancyGrid, count: int, seed: int = 0, clearance: float = 0.0
) -> Float[Array, "count 3"]:
    """Poses anywhere in free space, so far from walls [m]; the same ones every time."""
    rng = np.random.default_rng(seed)
    free = np.asarray(world.free) & (np.asarray(world.distance) > clearance)
    cell = np.flatnonzero(free)[rng.integers(0, free.sum(), count)]
    row, column = np.unravel_index(cell, free.shape)
    inside = np.stack([column, row], axis=1) + rng.uniform(0.1, 0.9, (count, 2))
    heading = jnp.asarray(rng.uniform(-np.pi, np.pi, (count, 1)), float)
    position = world.to_map(jnp.asarray(inside, float))
    return jnp.concatenate([position, heading], axis=1)


def simulated_scans(
    world: OccupancyGrid, count: int, seed: int = 0, outliers: float = 0.2
) -> tuple[Scan, Float[Array, "count 3"]]:
    """Noisy 270° scans of 360 rays from random places in the open, and their poses."""
    poses = random_poses(world, count, seed, _CLEARANCE)
    lidar = Lidar.create(
        rays=360, field_of_view=1.5 * np.pi, noise=0.02, outliers=outliers
    )
    keys = jax.random.split(jax.random.key(seed), count)
    return _taken(lidar, world, keys, poses), poses


@jax.jit
def _taken(lidar, world, keys, poses):
    cast = lambda pose: raycast(world, pose, lidar.bearings, lidar.range_max)
    return jax.vmap(lidar.measure)(keys, jax.vmap(cast)(poses))


def rays_from(world: OccupancyGrid, poses: int, rays: int) -> Callable[[], jax.Array]:
    """Work: so many rays all around from so many places."""
    places = random_poses(world, poses)
    bearings = jnp.linspace(-jnp.pi, jnp.pi, rays, endpoint=False)
    cast = jax.jit(jax.vmap(raycast, in_axes=(None, 0, None, None)))
    return lambda: cast(world, places, bearings, 30.0)


def _raycast(scene: Scene) -> Stage:
    """Exact ranges of 360 rays from random places, to 30 m."""
    poses = scene.amounts.poses
    return Stage(rays_from(scene.world, poses, 360), "Mrays/s", 360e-6 * poses)


def _orientation(scene: Scene) -> Stage:
    """The heading of one scan against another, by correlation (Fourier-Mellin)."""
    ranges = rays_from(scene.world, scene.amounts.poses, 360)()
    turned = jnp.roll(ranges, 50, axis=1)
    turn = jax.jit(jax.vmap(fourier_mellin))
    thousands = scene.amounts.poses / 1e3
    return Stage(lambda: turn(ranges, turned), "1000 headings/s", thousands)


def _match(scene: Scene) -> Stage:
    """One scan against the map from 0.2 m and 20° off, covariance and verdict."""
    scan, pose = scene.scan
    start = np.asarray(pose) + np.array([0.15, -0.12, 0.35])
    return Stage(lambda: match_scan(scene.world, scan, start), "ms")


def _query(scene: Scene) -> Stage:
    """`localise`: one scan, no prior, the whole floor."""
    atlas, (scan, _) = scene.atlas, scene.scan
    return Stage(lambda: localise(atlas, scan), "ms")


def _batch(scene: Scene) -> Stage:
    """`localise_batch`."""
    atlas, (scans, poses) = scene.atlas, scene.scans
    return Stage(lambda: localise_batch(atlas, scans), "scans/s", len(poses))


def _tracker(scene: Scene) -> Stage:
    """A step of the tracker, 360 rays, with odometry."""
    scan, pose = scene.scan
    state = tracker.init(scene.world, pose, odometry=jnp.zeros(3))
    moved = jnp.array([0.05, 0.0, 0.02])
    return Stage(lambda: tracker.step(scene.world, state, scan, moved), "ms")


def _particles(scene: Scene) -> Stage:
    """An update of the particle filter, 60 rays a particle, drawn again each time."""
    scan, pose = scene.scan
    count = scene.amounts.particles
    config = particles.ParticleConfig(kld=Kld(count, count), resample_interval=1)
    spread = jnp.diag(jnp.array([0.25, 0.25, 0.07]))
    cloud = init_at(jax.random.key(0), pose, spread, config)
    step = jax.jit(particles.step)
    state, moved = cloud._replace(odometry=jnp.zeros(3)), jnp.array([0.1, 0.0, 0.02])
    go = lambda: step(jax.random.key(1), scene.world, state, scan, moved, config)
    return Stage(go, "updates/s", 1)


def _slam(scene: Scene) -> Stage:
    """A step of L-SLAM, 100 particles of 100 landmarks, whose names are known."""
    del scene
    start, controls = Circle(laps=1.0).way(Car())
    config = SlamConfig(particles=_FILTER, landmarks=_FILTER, association=None)
    keys = jax.random.split(jax.random.key(0), 3)
    places = scatter(keys[0], _FILTER)
    drive = jax.jit(simulate)(
        keys[1], places, start, controls, config.vehicle, config.sensor
    ).drive
    state = init(config, keys[2], start)
    go = jax.jit(run)
    return Stage(lambda: go(config, state, drive), "steps/s", len(controls))


STAGES: dict[str, Callable[[Scene], Stage]] = {
    "raycast": _raycast,
    "orientation": _orientation,
    "match": _match,
    "query": _query,
    "batch": _batch,
    "tracker": _tracker,
    "particles": _particles,
    "slam": _slam,
}


def measure(scene: Scene, names: Sequence[str], repeats: int) -> Iterator[Metric]:
    """Three rows a stage: what it does, in units of the reference, and the first call.

    Only the ratio is held against the baseline, and of it the lower quartile: between a
    quiet and a busy hour medians of work of milliseconds were seen to vary 3.5-fold,
    lower quartiles 1.7-fold.
    """
    for name in names:
        stage = STAGES[name](scene)
        took = clock(stage.work, repeats)
        way = "lower" if stage.amount is None else "higher"
        spread = sorted((stage.told(took.low), stage.told(took.high)))
        value = stage.told(took.median)
        yield Metric(f"{name}/speed", value, stage.unit, way, spread=spread)
        ratio, key, unit = took.ratio_low, f"{name}/ratio", "× reference"
        scatter = ratio, took.ratio_high
        yield Metric(key, ratio, unit, "lower", None, _WORSE, scatter)
        yield Metric(f"{name}/first_call", took.first, "s", "lower")
