"""Monte Carlo localisation: finds, keeps, repeats, and never says NaN."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import Lidar, build_atlas, buildings
from fsmsm_jax.evaluation import pose_errors, success
from fsmsm_jax.evaluation.drives import drive, plan
from fsmsm_jax.localisation.clouds import init_at, init_from_atlas, init_uniform
from fsmsm_jax.localisation.feedback import Feedback, ScanMatching
from fsmsm_jax.localisation.likelihood import CaerLikelihood, LikelihoodField
from fsmsm_jax.localisation.motion import OdometryModel, spread
from fsmsm_jax.localisation.particles import ParticleConfig, run, step
from fsmsm_jax.resampling import Kld
from tests.worlds import random_grid, square_room

ABOUT = jnp.diag(jnp.asarray([0.25, 0.25, 0.0685]))
WHEELS = OdometryModel(drift=(0.02, 0.01))
SMALL = ParticleConfig(
    kld=Kld(40, 150), likelihood=LikelihoodField(rays=30), motion=WHEELS
)
jitted_step, jitted_run = jax.jit(step), jax.jit(run)


@pytest.fixture(scope="module")
def world():
    return buildings.office(1, 14.0, 10.0)


@pytest.fixture(scope="module")
def log(world):
    row, column = np.nonzero(np.asarray(world.free & (world.distance >= 0.6)))
    ends = np.stack([column, row], axis=1)[[0, -1]] + 0.5
    start, goal = np.asarray(world.to_map(jnp.asarray(ends, float)), float)
    lidar = Lidar.create(180, 4.7, 12.0, noise=0.02)
    return drive(
        jax.random.key(0), world, lidar, plan(world, start, goal, 0.3), rate_hz=2.0
    )


def scan_at(log, index):
    return jax.tree.map(lambda a: a[index], log.scans)


def test_it_keeps_its_place(world, log):
    """And settles on the fewest particles, on a whole drive."""
    config = ParticleConfig(
        motion=WHEELS,
        likelihood=LikelihoodField(rule="product"),
        matching=ScanMatching(rays=60),
    )
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, config)
    state, infos = jitted_run(
        jax.random.key(2), world, cloud, log.scans, log.odometry, config
    )
    metres, radians = pose_errors(infos.pose, log.poses)
    assert np.median(metres) < 0.1
    assert np.median(radians) < 0.05
    assert np.max(metres[10:]) < 0.4
    better, _ = pose_errors(infos.corrected, log.poses)
    assert np.median(better) < 0.02
    assert np.mean(infos.matched) > 0.9
    assert np.median(infos.living[10:]) == 200 == np.min(infos.living)
    assert infos.living[0] == 500
    for leaf in jax.tree.leaves((state, infos)):
        assert np.isfinite(np.where(np.isneginf(leaf), 0, leaf)).all()


@pytest.mark.parametrize("manner", ["soft_p", "hard"])
def test_feedback_keeps_it_nearer(world, log, manner):
    told = ParticleConfig(
        motion=WHEELS, matching=ScanMatching(rays=60), feedback=Feedback(manner)
    )
    some = jax.tree.map(lambda a: a[:25], log.scans)
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, told)
    state, infos = jitted_run(
        jax.random.key(2), world, cloud, some, log.odometry[:25], told
    )
    metres, _ = pose_errors(infos.pose, log.poses[:25])
    assert np.median(metres[5:]) < 0.15
    assert int(state.living) <= 500
    np.testing.assert_allclose(np.exp(state.log_weights).sum(), 1, atol=1e-4)


def test_caer_weighs_as_well(world, log):
    config = ParticleConfig(
        kld=Kld(100, 100), likelihood=CaerLikelihood(rays=20), motion=WHEELS
    )
    some = jax.tree.map(lambda a: a[:15], log.scans)
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, config)
    _, infos = jitted_run(
        jax.random.key(2), world, cloud, some, log.odometry[:15], config
    )
    metres, _ = pose_errors(infos.pose, log.poses[:15])
    assert np.median(metres[5:]) < 0.15


def test_many_seeds_are_many_runs(world, log):
    """vmap == loop, scan == loop, jit == eager, to rounding."""
    some = jax.tree.map(lambda a: a[:20], log.scans)  # compiled for the next test, too
    keys = jax.random.split(jax.random.key(3), 3)
    begin = lambda key: init_at(key, log.poses[0], ABOUT, SMALL)
    ask = lambda key, cloud: run(key, world, cloud, some, log.odometry[:20], SMALL)
    clouds = jax.vmap(begin)(keys)
    _, together = jax.jit(jax.vmap(ask))(keys, clouds)
    for n, key in enumerate(keys):
        cloud = jax.tree.map(lambda a, n=n: a[n], clouds)
        _, alone = jitted_run(key, world, cloud, some, log.odometry[:20], SMALL)
        # What is rounded differently is drawn differently sooner or later.
        np.testing.assert_allclose(together.pose[n, :4], alone.pose[:4], atol=1e-4)
        assert np.array_equal(together.living[n, :4], alone.living[:4])
    split = jax.random.split(keys[0], 20)
    state = init_at(keys[0], log.poses[0], ABOUT, SMALL)
    for n, key in enumerate(split[:4]):
        state, info = step(key, world, state, scan_at(log, n), log.odometry[n], SMALL)
        np.testing.assert_allclose(together.pose[0, n], info.pose, atol=1e-3)


def test_the_first_scan_weighs_and_standing_still_does_not(world, log):
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, SMALL)
    scan = scan_at(log, 0)
    state, info = jitted_step(
        jax.random.key(2), world, cloud, scan, log.odometry[0], SMALL
    )
    assert bool(info.updated)
    assert np.array_equal(state.poses, cloud.poses)
    nudged = log.odometry[0] + jnp.asarray([0.004, 0.004, 0.01])
    again, info = jitted_step(jax.random.key(3), world, state, scan, nudged, SMALL)
    assert not bool(info.updated)
    for new, old in zip(again, state, strict=True):
        assert np.array_equal(new, old)


def test_odometry_that_is_not_finite_is_skipped(world, log):
    """And made good by the next: the robot has moved all the way."""
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT / 100, SMALL)
    bad = log.odometry.at[3:6].set(jnp.nan).at[8, 1].set(jnp.inf)
    some = jax.tree.map(lambda a: a[:20], log.scans)
    state, infos = jitted_run(jax.random.key(2), world, cloud, some, bad[:20], SMALL)
    assert infos.updated[:10].tolist() == [True] * 3 + [False] * 3 + [
        True,
        True,
        False,
        True,
    ]
    assert np.isfinite(np.asarray(infos.pose)).all()
    assert np.isfinite(np.asarray(state.poses)).all()
    metres, _ = pose_errors(infos.pose[-1], log.poses[19])
    assert metres < 0.4


def test_a_scan_without_information_leaves_the_weights(world, log):
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, SMALL)
    scan = scan_at(log, 0)
    blind = scan.__class__(
        ranges=jnp.full_like(scan.ranges, 12.0),
        bearings=scan.bearings,
        valid=jnp.zeros_like(scan.valid),
        echo=jnp.zeros_like(scan.echo),
        range_max=scan.range_max,
    )
    state, info = jitted_step(
        jax.random.key(2), world, cloud, blind, log.odometry[0], SMALL
    )
    np.testing.assert_allclose(state.log_weights, cloud.log_weights, atol=1e-5)
    assert np.isfinite(np.asarray(info.pose)).all()


def test_weights_that_all_vanish_are_kept(world, log):
    impossible = ParticleConfig(
        kld=Kld(40, 150), likelihood=LikelihoodField(rule="product", z_rand=0.0)
    )
    nowhere = jnp.asarray([900.0, 900.0, 0.0])
    cloud = init_at(jax.random.key(1), nowhere, ABOUT, impossible)
    state, info = jitted_step(
        jax.random.key(2), world, cloud, scan_at(log, 0), log.odometry[0], impossible
    )
    np.testing.assert_allclose(state.log_weights, cloud.log_weights, atol=1e-5)
    assert np.isfinite(np.asarray(info.pose)).all()
    assert float(info.effective) == pytest.approx(150, rel=1e-3)


def test_resampling_comes_at_its_interval(world, log):
    config = ParticleConfig(
        kld=Kld(40, 150), resampler="residual", resample_interval=3, motion=WHEELS
    )
    cloud = init_at(jax.random.key(1), log.poses[0], ABOUT, config)
    some = jax.tree.map(lambda a: a[:9], log.scans)
    _, infos = jitted_run(
        jax.random.key(2), world, cloud, some, log.odometry[:9], config
    )
    assert np.asarray(infos.resampled).tolist() == [False, False, True] * 3
    assert np.all(np.asarray(infos.living) <= 150)


def test_prediction_is_the_motion_model_from_where_it_was(log):
    """Without a scan the cloud spreads as the linearised model says."""
    model = OdometryModel(floor=(0.0, 0.0), drift=(0.0, 0.0))
    config = ParticleConfig(kld=Kld(20_000, 20_000), motion=model, resample_interval=99)
    room, pose = square_room(200.0), jnp.asarray([12.5, -7.25, 2.0])
    cloud = init_at(jax.random.key(0), pose, jnp.zeros((3, 3)), config)
    scan = scan_at(log, 0)
    blind = jax.tree.map(lambda a: a, scan)
    blind = blind.__class__(
        scan.ranges,
        scan.bearings,
        scan.valid & False,
        scan.echo & False,
        scan.range_max,
    )
    odometry = jnp.asarray([[5.0, 5.0, 1.0], [5.2, 5.1, 1.05]])
    state, _ = jitted_step(jax.random.key(1), room, cloud, blind, odometry[0], config)
    state, info = jitted_step(
        jax.random.key(2), room, state, blind, odometry[1], config
    )
    back = lambda angle: np.array(
        [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    )
    moved = np.array([*(back(1.0) @ [0.2, 0.1]), 0.05])
    expected = np.asarray(spread(model, jnp.asarray(moved, float)))
    turn = np.eye(3)
    turn[:2, :2] = back(2.0).T
    np.testing.assert_allclose(
        np.asarray(info.pose)[:2], [12.5, -7.25] + back(2.0).T @ moved[:2], atol=2e-3
    )
    np.testing.assert_allclose(info.covariance, turn @ expected @ turn.T, atol=1e-4)


@pytest.mark.parametrize(
    "make", [lambda: random_grid(4), square_room], ids=["grid", "polygons"]
)
def test_anywhere_is_free_and_even(make):
    world = make()
    config = ParticleConfig(kld=Kld(200, 4000))
    cloud = init_uniform(jax.random.key(0), world, config)
    assert bool(world.contains(cloud.poses[:, :2]).all())
    assert not bool(world.unknown_at(cloud.poses[:, :2]).any())
    assert abs(float(jnp.mean(cloud.poses[:, 2]))) < 0.15
    if hasattr(world, "cells"):
        cells = jnp.floor(world.to_cells(cloud.poses[:, :2]))
        middle = np.argwhere(np.asarray(world.free)).mean(axis=0)[::-1] + 0.5
        np.testing.assert_allclose(cells.mean(axis=0) + 0.5, middle, atol=2.5)


def test_the_atlas_begins_where_dispersion_ends(world, log):
    """500 particles from the atlas are right at once; 2000 all over the map are not."""
    atlas = build_atlas(world)
    right = {"atlas": [], "anywhere": []}
    for n in (0, 20, 40):
        some = jax.tree.map(lambda a, n=n: a[n : n + 6], log.scans)
        odometry, true = log.odometry[n : n + 6], log.poses[n : n + 6]
        begins = {
            "atlas": lambda config, n=n: init_from_atlas(
                jax.random.key(n), atlas, scan_at(log, n), config
            ),
            "anywhere": lambda config, n=n: init_uniform(
                jax.random.key(n), world, config
            ),
        }
        for name, most in (("atlas", 500), ("anywhere", 2000)):
            config = ParticleConfig(
                kld=Kld(200, most),
                likelihood=LikelihoodField(rays=30, rule="product"),
                resample_interval=2,
                motion=WHEELS,
            )
            _, infos = jitted_run(
                jax.random.key(9), world, begins[name](config), some, odometry, config
            )
            right[name].append(np.asarray(success(infos.pose, true)))
    updates = {name: 6 - np.sum(r, axis=1) for name, r in right.items()}
    assert np.all(updates["atlas"] <= 1)
    assert np.mean(updates["anywhere"]) > np.mean(updates["atlas"]) + 1


def test_contracts():
    expected = ["key", "world", "state", "scan", "odometry", "config"]
    assert list(inspect.signature(step).parameters) == expected
    for init in (init_at, init_uniform, init_from_atlas):
        names = list(inspect.signature(init).parameters)
        assert (names[0], names[-1]) == ("key", "config")
    with pytest.raises(ValueError, match="matching=ScanMatching"):
        ParticleConfig(feedback=Feedback("soft_p"))
    with pytest.raises(ValueError, match="resampler must be"):
        ParticleConfig(resampler="wheel")


def test_numbers_in_the_config_do_not_compile_again(world, log):
    traces = []

    @jax.jit
    def counted(key, config):
        traces.append(None)
        cloud = init_at(key, log.poses[0], ABOUT, config)
        return step(key, world, cloud, scan_at(log, 0), log.odometry[0], config)[1]

    for z_hit, error in ((0.95, 0.01), (0.8, 0.05), (0.5, 0.1)):
        config = ParticleConfig(
            kld=Kld(40, 150, error), likelihood=LikelihoodField(rays=30, z_hit=z_hit)
        )
        jax.eval_shape(counted, jax.random.key(0), config)
    assert len(traces) == 1
