"""Do the filters know how wrong they are? NEES over many runs, and what it should be.

Bailey, Nieto and Nebot (2006) found that FastSLAM grows too sure with time: particles
that are drawn again forget what else could have been. L-SLAM has more ways to err. Its
position is shared by landmarks that are correlated with it, and that is not kept; its
headings die out as FastSLAM's poses do. So it is measured in three worlds:

- *known headings*: a robot whose turn rate is exact. Nothing is left to be drawn, one
  particle is all there is, and `lslam_joint` is a Kalman filter in a linear world: it
  has to be inside its bounds. What `lslam` is beyond them, sharing costs.
- the world of figure 2b, with 40 particles;
- a lap among ten landmarks, small enough for `lslam_joint` with hundreds of particles.
"""

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from thesis.report import Table, number, save

from fsmsm_jax import geometry
from fsmsm_jax.evaluation.slam import Consistency, chi2_bounds, consistency
from fsmsm_jax.plotting.colours import INK
from fsmsm_jax.plotting.slam import SLAM_COLOURS
from fsmsm_jax.slam.filter import SlamConfig
from fsmsm_jax.slam.methods import Name
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.simulate import Circle, Simulated, scatter, simulate
from fsmsm_jax.slam.vehicle import Car, DiffDrive, Vehicle
from lslam.runs import METHODS, Options, found

RUNS, ALONE = 50, 300  # one particle is cheap, and steps of a run go together
FEW = 10  # landmarks of the small world
HEAD = (
    *("method", "particles", "position: mean, 2 if honest", "steps inside"),
    *("pose: mean, 3 if honest", "steps inside", "last 50 looks, position"),
)
_LAST = 50

EKF: tuple[Name, int] = ("ekf", 1)
NOTHING_DRAWN: tuple[tuple[Name, int], ...] = (("lslam", 1), ("lslam_joint", 1), EKF)
COMPARED: tuple[Name, ...] = ("fastslam2", "lslam", "lslam_joint")
MANY: tuple[tuple[Name, int], ...] = (
    *((m, p) for p in (40, 200) for m in COMPARED),
    ("lslam2", 200),
    ("lslam2_joint", 200),
    EKF,
)

Row = tuple[Name, int, Consistency, Consistency | None]


def consistent(options: Options) -> Iterator[Table]:
    """Three worlds, a row for each filter."""
    runs = 10 if options.quick else RUNS
    robot = DiffDrive(noise=(0.4, 0.0))
    alone = runs if options.quick else ALONE
    start, drives = _drives(alone, Circle(), robot, 25)
    rows = _rows(start, drives, robot, NOTHING_DRAWN, 25)
    yield _table("NEES, headings known", rows, alone)
    _draw(options, rows, "known", "headings known")

    car = Car()
    start, drives = _drives(runs, Circle(), car, 25)
    particles = 5 if options.quick else 40
    all_of = [*((method, particles) for method in METHODS), EKF]
    rows = _rows(start, drives, car, all_of, 25)
    yield _table("NEES, the world of figure 2b", rows, runs)
    _draw(options, rows, "world", "the world of figure 2b")
    if options.quick:
        return

    start, drives = _drives(runs, Circle(laps=1.0), car, FEW)
    rows = _rows(start, drives, car, MANY, FEW)
    yield _table(f"NEES, one lap among {FEW} landmarks", rows, runs)
    _draw(options, rows, "lap", f"one lap among {FEW} landmarks")


def _drives(
    runs: int, circle: Circle, vehicle: Vehicle, landmarks: int
) -> tuple[jax.Array, Simulated]:
    """A world of its own for each run; a robot turns at the rate of the circle."""
    start, controls = circle.way(Car())
    if isinstance(vehicle, DiffDrive):
        controls = controls.at[..., 1].set(circle.speed / circle.radius)
    one = lambda key: simulate(
        key[0],
        scatter(key[1], landmarks),
        *(start, controls, vehicle, RangeBearing()),
    )
    keys = jax.random.split(jax.random.key(11), (runs, 2))
    return start, jax.jit(jax.vmap(one))(keys)


def _rows(
    start: jax.Array,
    drives: Simulated,
    vehicle: Vehicle,
    asked: Sequence[tuple[Name, int]],
    landmarks: int,
) -> list[Row]:
    keys = jax.random.split(jax.random.key(12), len(drives.poses))
    rows = []
    for method, particles in asked:
        config = SlamConfig(
            method=method,
            particles=particles,
            landmarks=landmarks,
            vehicle=vehicle,
            association=None,
        )
        info = found(config, start, keys, drives.drive).info
        off = jnp.asarray(info.mean) - drives.poses
        off = np.array(off.at[..., 2].set(geometry.wrap(off[..., 2])))
        place = consistency(off[..., :2], info.covariance[..., :2, :2])
        pose = consistency(off, info.covariance)
        unknown = np.isnan(pose.average[1:]).all()  # headings that nobody doubts
        rows.append((method, particles, place, None if unknown else pose))
    return rows


def _table(title: str, rows: Sequence[Row], runs: int) -> Table:
    bounds = ["{:.2f} to {:.2f}".format(*chi2_bounds(runs, k)) for k in (2, 3)]
    note = (
        f"{runs} runs; 95 % of honest averages: position {bounds[0]}, pose {bounds[1]}."
    )
    share = lambda some: f"{100 * some.inside:.0f} %"
    lines = []
    for method, particles, place, pose in rows:
        late = np.nanmean(place.average[-_LAST:])
        whole = ("", "") if pose is None else (number(pose.mean), share(pose))
        lines.append(
            (
                *(method, str(particles), number(place.mean), share(place)),
                *(*whole, number(late)),
            )
        )
    return Table(title, HEAD, lines, note)


def _draw(options: Options, rows: Sequence[Row], name: str, title: str) -> None:
    if options.out is None:
        return
    figure = Figure(figsize=(7, 4))
    ax = figure.add_subplot()
    bounds = rows[0][2]
    for method, particles, place, _ in rows:
        style = {"color": SLAM_COLOURS[method], "lw": 0.5 + particles / 200}
        ax.plot(place.average, label=f"{method}, {particles}", **style)
    ax.axhspan(bounds.low, bounds.high, color=INK, alpha=0.15, lw=0)
    ax.set_yscale("log")
    ax.set(xlabel="look", ylabel="NEES of the position", title=title)
    ax.legend(frameon=False, ncols=2)
    save(figure, options.out, f"lslam_nees_{name}")
