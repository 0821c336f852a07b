"""The filter by itself: how fast it is, and how it finds its place without a prior."""

import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from thesis.report import Table, number

from fsmsm_jax import Lidar, build_atlas
from fsmsm_jax.evaluation import success
from fsmsm_jax.evaluation.drives import Drive, drive, plan
from fsmsm_jax.localisation.clouds import init_at, init_from_atlas, init_uniform
from fsmsm_jax.localisation.likelihood import CaerLikelihood, LikelihoodField
from fsmsm_jax.localisation.motion import OdometryModel
from fsmsm_jax.localisation.particles import ParticleConfig, run
from fsmsm_jax.resampling import Kld
from fsmsm_jax.world import OccupancyGrid, buildings
from particles.navigation import INITIAL, Options

MANY = 10_000
AFTER = (1, 5, 10, 20, 40)
SPREAD_OVER = (500, 5_000, 20_000)
HEAD_SPEED = ("likelihood", "particles x rays", "updates/s", "goal")
HEAD_GLOBAL = ("begins", "particles", *(f"right after {n}" for n in AFTER), "s a drive")

WHEELS = OdometryModel(drift=(0.02, 0.01))
SETTLING = ParticleConfig(
    motion=WHEELS, likelihood=LikelihoodField(rule="product"), kld=Kld(200, MANY)
)

compiled = jax.jit(run)


def speed(options: Options) -> Iterator[Table]:
    """Updates a second of one filter, resampling included, and what KLD saves."""
    world, log = _office(0)
    scans = 10 if options.quick else 60
    rows = []
    for name, model, most in (
        ("field, sum of cubes", LikelihoodField(), MANY),
        ("field, product", LikelihoodField(rule="product"), MANY),
        ("CAER", CaerLikelihood(), MANY // 10),
    ):
        config = ParticleConfig(
            likelihood=model, kld=Kld(most, most), resample_interval=1
        )
        _, seconds = _timed(world, log, scans, config)
        goal = "30" if most == MANY and not isinstance(model, CaerLikelihood) else ""
        rows.append((name, f"{most} x {model.rays}", number(scans / seconds), goal))
    note = "One filter on the CPU, drawn again at every scan, the best of three runs."
    yield Table("Speed", HEAD_SPEED, rows, note)
    infos, seconds = _timed(world, log, scans, SETTLING)
    living = np.asarray(infos.living)
    rows = [(str(n + 1), str(living[n])) for n in range(0, scans, max(1, scans // 12))]
    note = f"From σ 0.5 m and 15° with room for {MANY}, N_min 200; {scans / seconds:.0f} updates/s."
    yield Table("KLD-sampling", ("scan", "particles"), rows, note)


def _timed(world, log: Drive, scans: int, config: ParticleConfig):
    some = jax.tree.map(lambda a: a[:scans], log.scans)
    about = jnp.asarray(INITIAL, log.poses.dtype)
    cloud = init_at(jax.random.key(0), log.poses[0], about, config)
    args = (world, cloud, some, log.odometry[:scans], config)
    once = lambda: jax.block_until_ready(compiled(jax.random.key(0), *args))
    _, infos = once()  # compiles
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        once()
        seconds.append(time.perf_counter() - start)
    return infos, min(seconds)


def global_start(options: Options) -> Iterator[Table]:
    """Where the atlas says, against particles all over the map."""
    drives = 2 if options.quick else 20
    scans = max(AFTER) + 1
    sizes = SPREAD_OVER[:1] if options.quick else SPREAD_OVER
    begins = [("at the atlas's candidates", 500), *(("anywhere", n) for n in sizes)]
    right, seconds = ({b: [] for b in begins} for _ in range(2))
    for seed in range(drives):
        world, log = _office(seed)
        atlas = build_atlas(world)
        some, odometry = (
            jax.tree.map(lambda a: a[:scans], part)
            for part in (log.scans, log.odometry)
        )
        first = jax.tree.map(lambda a: a[0], some)
        for begin in begins:
            config = ParticleConfig(
                likelihood=LikelihoodField(rays=30, rule="product"),
                kld=Kld(500, begin[1]),
                resample_interval=2,
                motion=WHEELS,
            )
            key_begin, key = jax.random.split(jax.random.key(seed))
            start = time.perf_counter()
            if begin[0] == "anywhere":
                cloud = init_uniform(key_begin, world, config)
            else:
                cloud = init_from_atlas(key_begin, atlas, first, config)
            _, infos = compiled(key, world, cloud, some, odometry, config)
            right[begin].append(np.asarray(success(infos.pose, log.poses[:scans])))
            seconds[begin].append(time.perf_counter() - start)
    rows = [
        (
            *(name, str(size)),
            *(
                f"{100 * np.mean([r[n - 1] for r in right[name, size]]):.0f} %"
                for n in AFTER
            ),
            number(np.median(seconds[name, size])),
        )
        for name, size in begins
    ]
    note = (
        f"{drives} generated offices of 20 m x 15 m, a drive through each; right: within "
        "0.3 m and 5°. 30 rays, their product, drawn again at every second scan, "
        f"KLD-sampling down to 500; {scans} scans."
    )
    yield Table("Begin without a prior", HEAD_GLOBAL, rows, note)


def _office(seed: int) -> tuple[OccupancyGrid, Drive]:
    """A floor and a drive from one of its corners to the other."""
    world = buildings.office(seed, 20.0, 15.0)
    row, column = np.nonzero(np.asarray(world.free & (world.distance >= 0.6)))
    ends = np.stack([column, row], axis=1)[[0, -1]] + 0.5
    start, goal = np.asarray(world.to_map(jnp.asarray(ends, float)), float)
    lidar = Lidar.create(360, range_max=20.0, noise=0.02)
    way = plan(world, start, goal, 0.3)
    return world, drive(jax.random.key(seed), world, lidar, way)
