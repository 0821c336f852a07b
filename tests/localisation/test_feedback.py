"""Selection and feedback against the thesis's listings, written as plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import Lidar, raycast
from fsmsm_jax.localisation.feedback import (
    Feedback,
    ScanMatching,
    Selection,
    correct,
    feed_back,
    gaussian_cloud,
    select,
    weighted_pose,
)
from tests.worlds import CENTRE, l_room, square_room

ROOM = 40


def cloud(seed, count, room=ROOM):
    """Poses far from the origin, and weights of which the rest is dead."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, 0.1, (room, 3)) + [*CENTRE, 3.1]
    weights = np.where(np.arange(room) < count, rng.uniform(0.1, 1, room), 0.0)
    weights /= weights.sum()
    with np.errstate(divide="ignore"):
        return (
            jnp.asarray(poses, float),
            jnp.asarray(np.log(weights), float),
            jnp.asarray(count),
        )


def selected_by_hand(weights, selection):
    """Algorithm III; weights of the living only."""
    if selection.manner == "relative":
        kept = [j for j, w in enumerate(weights) if w > np.mean(weights)]
    else:
        order = sorted(range(len(weights)), key=lambda j: -weights[j])
        many = int(np.floor(float(selection.fraction) * len(weights) + 1e-9))
        kept = order[: max(many, 1)]
    out = np.zeros(len(weights))
    out[kept] = weights[kept]
    return out / out.sum()


@pytest.mark.parametrize(
    "selection",
    [
        Selection(),
        Selection("relative"),
        Selection("absolute", 0.1),
        Selection("absolute", 0.0),
    ],
    ids=["all", "above the mean", "tenth", "top"],
)
@pytest.mark.parametrize("count", [1, 9, 30, ROOM])
def test_selection_is_the_thesis_listing(selection, count):
    _, log_weights, living = cloud(1, count)
    weights = np.exp(np.asarray(log_weights, float))[:count]
    expected = selected_by_hand(weights, selection) if count > 1 else np.ones(1)
    for f in (select, jax.jit(select)):
        found = np.asarray(f(log_weights, living, selection))
        np.testing.assert_allclose(found[:count], expected, atol=1e-6)
        assert not found[count:].any()


def test_equal_weights_are_all_selected():
    log_weights = jnp.full(10, -3.0)
    found = select(log_weights, jnp.asarray(8), Selection("relative"))
    np.testing.assert_allclose(found, np.r_[np.full(8, 1 / 8), 0, 0], atol=1e-7)


def test_tiny_weights_do_not_underflow():
    log_weights = jnp.asarray([-900.0, -901.0, -jnp.inf, -950.0])
    found = np.asarray(select(log_weights, jnp.asarray(4)))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[0] / found[1], np.e, rtol=1e-5)


def test_mean_goes_round_the_circle_and_does_not_mind_the_origin():
    rng = np.random.default_rng(0)
    off = rng.normal(0, 0.05, (200, 3))
    weights = rng.uniform(0, 1, 200)
    weights /= weights.sum()
    mean = weights @ off
    spread = np.einsum("n,ni,nj->ij", weights, off - mean, off - mean)
    for where in ([0, 0, 0], [2000.0, -3000.0, np.pi], [40.0, 7.0, -np.pi + 0.01]):
        poses = off + where
        poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
        pose, covariance = weighted_pose(
            jnp.asarray(poses, float), jnp.asarray(weights, float)
        )
        left = np.asarray(pose) - where - mean
        left[2] = np.angle(np.exp(1j * left[2]))
        # Coordinates of kilometres are known to 0.2 mm in float32.
        np.testing.assert_allclose(left, 0, atol=5e-4)
        np.testing.assert_allclose(covariance, spread, atol=2e-4)


def test_headings_that_cancel_are_no_nan():
    poses = jnp.asarray([[1.0, 2.0, 0.0], [1.0, 2.0, np.pi]])
    pose, covariance = weighted_pose(poses, jnp.full(2, 0.5))
    assert np.isfinite(np.asarray(pose)).all()
    assert np.isfinite(np.asarray(covariance)).all()


def told_by_hand(poses, weights, room, pose, feedback):
    """Algorithm IV on lists: particles, and which of them are clones."""
    population = sorted(
        zip(weights, map(tuple, poses), strict=True), key=lambda p: -p[0]
    )
    size, q = len(population), float(feedback.share)
    if feedback.manner == "soft_1":
        deleted, added = int(size == room), 1
    elif size == room:
        deleted = added = int(np.floor(q * room + 1e-6))
    elif size <= (1 - q) * room:
        deleted, added = 0, int(np.floor(q / (1 - q) * size + 1e-6))
    else:
        deleted = int(np.floor(size - (1 - q) * room + 1e-6))
        added = int(np.floor(q * room + 1e-6))
    kept = population[: size - deleted]
    return [p for _, p in kept] + [tuple(pose)] * added, added


@pytest.mark.parametrize("count", [1, 10, 19, 20, 21, 33, 39, ROOM])
@pytest.mark.parametrize("manner", ["soft_1", "soft_p"])
@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
def test_feedback_is_the_thesis_listing(manner, share, count):
    poses, log_weights, living = cloud(2, count)
    pose = jnp.asarray([13.0, -7.0, 0.5])
    feedback = Feedback(manner, share)
    weights = np.exp(np.asarray(log_weights))[:count]
    expected, clones = told_by_hand(
        np.asarray(poses)[:count], weights, ROOM, np.asarray(pose), feedback
    )
    for f in (feed_back, jax.jit(feed_back)):
        after, after_weights, size = f(
            jax.random.key(0), poses, log_weights, living, pose, feedback
        )
        assert int(size) == len(expected)
        np.testing.assert_allclose(np.asarray(after)[: int(size)], expected, atol=1e-6)
        assert np.isneginf(np.asarray(after_weights)[int(size) :]).all()
        np.testing.assert_allclose(np.exp(after_weights).sum(), 1, atol=1e-5)
        assert (
            np.sum(np.all(np.asarray(after) == np.asarray(pose), axis=1)[: int(size)])
            == clones
        )


@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
def test_clones_are_their_share_of_the_population(share):
    poses, log_weights, _ = cloud(3, ROOM)
    pose = jnp.asarray([13.0, -7.0, 0.5])
    counts = np.arange(1, ROOM + 1)
    one = lambda count: feed_back(
        *(jax.random.key(0), poses, log_weights, count, pose),
        Feedback("soft_p", share),
    )
    after, _, size = jax.jit(jax.vmap(one))(jnp.asarray(counts))
    clones = np.all(np.asarray(after) == np.asarray(pose), axis=2)
    clones &= np.arange(ROOM) < np.asarray(size)[:, None]
    assert np.all(np.asarray(size) <= ROOM)
    # Whole numbers only: off by less than one particle.
    assert np.abs(clones.sum(axis=1) - share * np.asarray(size)).max() < 1


def test_weight_of_clones():
    poses, log_weights, living = cloud(4, 10)
    tell = lambda feedback: np.exp(
        feed_back(jax.random.key(0), poses, log_weights, living, poses[0], feedback)[1]
    )
    weights = tell(Feedback("soft_1"))
    assert weights[10] == pytest.approx(1 / 11, rel=1e-5)
    weights = tell(Feedback("soft_1", clone_weight=3.0))
    assert weights[10] == pytest.approx(3 / 13, rel=1e-5)
    weights = tell(Feedback("soft_1", clone_unit="sum"))
    assert weights[10] == pytest.approx(0.5, rel=1e-5)


def test_open_changes_nothing_and_hard_begins_again():
    poses, log_weights, living = cloud(5, 12)
    pose = jnp.asarray([13.0, -7.0, 3.1])
    same = feed_back(jax.random.key(0), poses, log_weights, living, pose, Feedback())
    for after, before in zip(same, (poses, log_weights, living), strict=True):
        assert np.array_equal(after, before)
    big = jnp.tile(poses, (100, 1)), jnp.full(4000, -np.inf).at[:12].set(0.0)
    after, weights, size = feed_back(
        jax.random.key(1), *big, living, pose, Feedback("hard")
    )
    assert int(size) == 4000
    np.testing.assert_allclose(np.exp(weights), 1 / 4000, rtol=1e-4)
    off = np.asarray(after) - np.asarray(pose)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    np.testing.assert_allclose(off.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose(off.std(axis=0), [0.5, 0.5, 0.2618], rtol=0.05)


def test_a_cloud_has_its_covariance_even_a_flat_one():
    flat = jnp.asarray([[0.04, 0.04, 0.0], [0.04, 0.04, 0.0], [0.0, 0.0, 0.01]])
    poses = gaussian_cloud(
        jax.random.key(0), jnp.asarray([30.0, -9.0, 1.0]), flat, 20_000
    )
    np.testing.assert_allclose(np.cov(np.asarray(poses).T), flat, atol=2e-3)
    np.testing.assert_allclose(poses[:, 0] - 30, poses[:, 1] + 9, atol=1e-4)


# Scan matching on top


def test_a_match_brings_the_output_home():
    room, true = l_room(), jnp.asarray([*CENTRE, 0.7])
    lidar = Lidar.create(360, 4.5, noise=0.005)
    exact = raycast(room, true, lidar.bearings, lidar.range_max)
    scan = lidar.measure(jax.random.key(0), exact)
    pose = true + jnp.asarray([0.08, -0.06, 0.05])
    found, matched = jax.jit(correct)(room, scan, pose)
    assert bool(matched)
    np.testing.assert_allclose(found, true, atol=5e-3)


def test_a_match_that_explains_less_or_nothing_is_refused():
    room, pose = square_room(), jnp.asarray([*CENTRE, 0.2])
    lidar = Lidar.create(120)
    blind = lidar.measure(jax.random.key(0), jnp.full(120, lidar.range_max))
    found, matched = correct(room, blind, pose)
    assert not bool(matched)
    assert np.array_equal(found, pose)
    outside = pose + jnp.asarray([50.0, 0.0, 0.0])
    exact = raycast(room, pose, lidar.bearings, lidar.range_max)
    found, matched = correct(room, lidar.measure(jax.random.key(0), exact), outside)
    assert not bool(matched)
    assert np.array_equal(found, outside)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Selection("best"), "'absolute' or 'relative'"),
        (lambda: Feedback("closed"), "manner must be"),
        (lambda: Feedback("soft_p", clone_unit="median"), "clone_unit"),
        (lambda: ScanMatching(rays=3), "at least 8 rays"),
    ],
)
def test_unknown_words(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
