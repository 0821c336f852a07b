"""What counts for a pose, what against it, and what is not to be believed.

Nothing here knows the judge's constants: only which of two cases is the better.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import judge as judge_module
from fsmsm_jax.localisation.judge import Evidence, explain, on_walls, trust
from fsmsm_jax.sensing import Lidar, Scan, raycast
from fsmsm_jax.world import PolygonMap
from tests.oracles.localisation import distance_to_walls, on_walls as true_on_walls
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE, l_room, rasterised_room

SENSOR = Lidar.create(180, noise=0.0, range_max=8.0)
POSE = jnp.asarray([*(CENTRE + [0.4, 0.3]), 0.6], float)
CERTAIN = jnp.diag(jnp.array([1e-6, 1e-6, 1e-6]))

judge = jax.jit(explain)
cast = jax.jit(raycast)


def scan_of(ranges, valid=True):
    """The sensor's scan with these ranges; from `range_max` on there is no echo."""
    valid = jnp.broadcast_to(jnp.asarray(valid), (180,))
    echo = valid & (ranges < SENSOR.range_max)
    ranges = jnp.where(echo, ranges, SENSOR.range_max)
    return Scan(ranges, SENSOR.bearings, valid, echo, SENSOR.range_max)


@pytest.fixture(scope="module")
def exact():
    return cast(l_room(), POSE, SENSOR.bearings, SENSOR.range_max)


def test_a_true_scan_is_explained_wholly(exact):
    found = judge(l_room(), scan_of(exact), POSE)
    assert float(found.explained) == 1
    assert float(found.caer_per_ray) < 1e-5


def test_no_other_pose_scores_higher(exact):
    world, scan, rng = l_room(), scan_of(exact), np.random.default_rng(0)
    best = float(judge(world, scan, POSE).score)
    last = best
    for metres in (0.05, 0.1, 0.2, 0.4):  # and the farther, the lower, on average
        scores = []
        for way in rng.uniform(-np.pi, np.pi, 8):
            step = metres * np.array([np.cos(way), np.sin(way), 0.0])
            scores.append(float(judge(world, scan, POSE + jnp.asarray(step)).score))
        assert max(scores) < best
        assert np.mean(scores) < last
        last = np.mean(scores)
    turned = [float(judge(world, scan, POSE.at[2].add(a)).score) for a in (-0.1, 0.1)]
    assert max(turned) < best


def test_caer_is_the_mean_over_what_both_see(exact):
    """By the oracle's casts, at a wrong pose, with echoes missing on either side."""
    world, pose = l_room(), POSE + jnp.array([0.3, -0.2, 0.4])
    ranges = jnp.where(jnp.arange(180) % 9 == 0, SENSOR.range_max, exact)
    scan = scan_of(ranges, jnp.arange(180) % 7 > 0)
    x, y, theta = np.asarray(pose, float)
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    headings = theta + np.asarray(SENSOR.bearings, float)
    limit = float(SENSOR.range_max)
    virtual = cast_walls(start, end, np.array([x, y]), headings, limit)
    both = np.asarray(scan.echo) & (virtual < limit)
    difference = np.abs(np.asarray(scan.ranges, float) - virtual)
    assert 0 < both.sum() < np.asarray(scan.valid).sum()
    found = judge(world, scan, pose)
    np.testing.assert_allclose(found.caer_per_ray, difference[both].mean(), rtol=1e-3)


def test_invalid_rays_have_no_say(exact):
    keep = jnp.arange(180) % 3 > 0
    garbage = jnp.where(keep, exact, 0.1 + 0.01 * jnp.arange(180))
    one = judge(l_room(), scan_of(exact, keep), POSE)
    other = judge(l_room(), scan_of(garbage, keep), POSE)
    np.testing.assert_array_equal(jnp.stack(one), jnp.stack(other))


def test_a_ray_through_a_wall_is_worse_than_one_that_was_stopped(exact):
    """In range of 20 rays: half a metre short (a person), half a metre long."""
    some = jnp.arange(180) % 9 == 0
    clear = float(judge(l_room(), scan_of(exact), POSE).score)
    scores = [
        float(judge(l_room(), scan_of(jnp.where(some, exact + off, exact)), POSE).score)
        for off in (-0.5, 0.5)
    ]
    assert scores[1] < scores[0] < clear


def test_one_ray_has_a_bounded_say(exact):
    """A metre off or six, it says no and no more."""
    scores = [
        float(judge(l_room(), scan_of(exact.at[90].set(r)), POSE).score)
        for r in (exact[90] + 1.0, exact[90] + 4.0)
    ]
    clear = float(judge(l_room(), scan_of(exact), POSE).score)
    assert clear > max(scores)
    assert abs(scores[0] - scores[1]) < 0.5 * (clear - max(scores))


def test_the_walls_thickness_is_taken_off():
    """Ranges that are all 4 cm longer fit walls drawn 4 cm too thick."""
    grid, _ = rasterised_room(0.0)
    pose = jnp.asarray(grid.to_map(jnp.array([110.0, 125.0])), float)
    pose = jnp.append(pose, 0.3)
    exact = cast(grid, pose, SENSOR.bearings, SENSOR.range_max)
    scan = scan_of(exact + 0.04)
    thick, thin = (float(judge(grid, scan, pose, b).score) for b in (0.04, 0.0))
    assert thick > thin


def test_nothing_valid_is_no_nan():
    for ranges, valid in ((jnp.full(180, 2.0), False), (jnp.full(180, 99.0), True)):
        found = judge(l_room(), scan_of(ranges, valid), POSE)
        assert np.isfinite(jnp.stack(found)).all()


def sure(scores=(0.0, -5.0), covariance=CERTAIN, score=None, **best):
    shares = {"explained": 1.0, "blocked": 0.0, "through": 0.0, **best}
    shares = {name: jnp.asarray(value, float) for name, value in shares.items()}
    ranked = jnp.asarray(scores, float)
    its = ranked[0] if score is None else jnp.asarray(score, float)
    best = Evidence(score=its, caer_per_ray=jnp.zeros(()), **shares)
    return bool(trust(ranked, best, covariance))


def test_people_in_the_way_are_forgiven_in_part():
    """The same score and lead: a third of the rays cut short is a reason for it."""
    scores = (-0.5, -0.9)
    assert not sure(scores=scores)
    assert sure(scores=scores, blocked=0.3)


def test_doubt_is_what_the_map_does_not_explain():
    """Whatever else the ranking takes off the scores."""
    scores = (-0.5, -0.9)
    assert sure(scores=scores, score=-0.2)
    assert not sure(scores=scores, score=-0.5)


def test_rays_through_walls_are_not_forgiven():
    assert not sure(through=0.2)


def test_what_is_explained_fixed_and_alone_is_trusted():
    assert sure()
    assert sure(scores=(0.0, -jnp.inf))  # no rival at all


def test_what_lacks_one_of_the_three_is_not():
    assert not sure(scores=(0.0, 0.0))
    assert not sure(scores=(-5.0, -5.001))
    assert not sure(explained=0.1)
    loose = jnp.diag(jnp.array([1.0, 1e-6, 1e-6]))
    turned = jnp.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1e-6]])
    assert not sure(covariance=loose)
    assert not sure(covariance=loose[::-1, ::-1].at[1, 1].set(1.0))
    assert not sure(covariance=turned)  # a corridor at 45°


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
def test_what_is_not_a_number_is_never_trusted(value):
    assert not sure(covariance=CERTAIN * value)
    assert not sure(scores=(jnp.nan, -5.0))
    assert not sure(explained=jnp.nan)


def test_a_negative_variance_is_no_certainty():
    """Rounding can make one, of all places, in a corridor."""
    assert not sure(covariance=jnp.diag(jnp.array([-4.0, 1e-6, 1e-6])))


def test_jit_and_vmap_change_nothing(exact):
    """Means of 180 float32 terms in another order."""
    world, scan = l_room(), scan_of(exact)
    poses = POSE[None] + jnp.linspace(-0.3, 0.3, 5)[:, None]
    many = jax.vmap(judge, (None, None, 0))(world, scan, poses)
    for i, pose in enumerate(poses):
        one = judge(world, scan, pose)
        np.testing.assert_allclose(jnp.stack(many)[:, i], jnp.stack(one), atol=1e-4)
    eager = explain(world, scan, POSE)
    jitted = judge(world, scan, POSE)
    np.testing.assert_allclose(jnp.stack(eager), jnp.stack(jitted), atol=1e-5)


WALL_RULES = (judge_module.ON_THE_WAY, judge_module._NEAR, judge_module.CLEAR_OF_WALL)

walls_met = jax.jit(on_walls)


def distances_in(world):
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    return lambda points: distance_to_walls(start, end, points)


def test_ends_on_walls_are_summed_ray_by_ray(exact):
    """At true and wrong poses, with echoes missing and rays that say nothing.

    Sums of 720 float32 terms, distances at 14 m from the origin: some 10⁻⁵.
    """
    rng = np.random.default_rng(5)
    missing = jnp.where(jnp.arange(180) % 9 == 0, SENSOR.range_max, exact)
    scan = scan_of(missing, jnp.arange(180) % 7 > 0)
    for off in [np.zeros(3), *rng.uniform(-0.8, 0.8, (6, 3))]:
        pose = np.asarray(POSE, float) + off
        wanted = true_on_walls(distances_in(l_room()), scan, pose, WALL_RULES)
        found = walls_met(l_room(), scan, jnp.asarray(pose, float))
        np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_rays_on_walls_make_one_at_most(exact):
    """At the truth nearly: grazing rays lead along walls before they end on them."""
    world, rng = l_room(), np.random.default_rng(6)
    assert 0.9 < float(walls_met(world, scan_of(exact), POSE)) <= 1
    for _ in range(20):
        scan = scan_of(jnp.asarray(rng.uniform(0.1, 9.0, 180), float))
        pose = POSE + jnp.asarray(rng.uniform(-3, 3, 3), float)
        assert float(walls_met(world, scan, pose)) <= 1
    close = scan_of(jnp.full(180, 0.5))  # no way is long enough to be probed
    ring = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = 0.5 * np.stack([np.cos(ring), np.sin(ring)], axis=1) + np.asarray(POSE)[:2]
    found = walls_met(PolygonMap.from_outlines(ring), close, POSE)
    np.testing.assert_allclose(found, 1.0, atol=1e-4)


def test_ends_are_on_walls_best_at_the_truth(exact):
    world, scan, rng = l_room(), scan_of(exact), np.random.default_rng(7)
    last = best = float(walls_met(world, scan, POSE))
    for metres in (0.05, 0.1, 0.2, 0.4):
        scores = []
        for way in rng.uniform(-np.pi, np.pi, 8):
            step = metres * np.array([np.cos(way), np.sin(way), 0.0])
            scores.append(float(walls_met(world, scan, POSE + jnp.asarray(step))))
        assert max(scores) < best
        assert np.mean(scores) < last
        last = np.mean(scores)
    turned = [float(walls_met(world, scan, POSE.at[2].add(a))) for a in (-0.1, 0.1)]
    assert max(turned) < best


@pytest.mark.parametrize("way", [(0.0, -1.0), (-1.0, 0.0), (1.0, 0.6), (0.3, 1.0)])
def test_a_pose_moved_through_a_wall_is_worse(exact, way):
    """Half a metre beyond the wall that it meets first, and into nothing."""
    world, scan = l_room(), scan_of(exact)
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    heading, here = np.arctan2(way[1], way[0]), np.asarray(POSE, float)
    (met,) = cast_walls(start, end, here[:2], [heading], 50.0)
    step = (met + 0.5) * np.array([np.cos(heading), np.sin(heading), 0.0])
    beyond = POSE + jnp.asarray(step, float)
    assert float(walls_met(world, scan, beyond)) < 0.4
    assert float(walls_met(world, scan, beyond)) < float(walls_met(world, scan, POSE))


def test_a_wall_on_the_way_counts_against(exact):
    """Where rays are probed, and for what rays are worth; beside them it does not."""
    clear = float(walls_met(l_room(), scan_of(exact), POSE))
    outline = (
        np.array([[-2, -1], [4, -1], [4, 1.5], [1, 1.5], [1, 5], [-2, 5]]) + CENTRE
    )
    longest = int(jnp.argmax(exact))
    toward = float(POSE[2] + SENSOR.bearings[longest])
    ahead, left = (
        np.array([np.cos(a), np.sin(a)]) for a in (toward, toward + np.pi / 2)
    )
    middle = np.asarray(POSE, float)[:2] + 0.55 * float(exact[longest]) * ahead
    wall = middle + np.outer([-0.6, 0.6, 0.6], left) + [[0, 0], [0, 0], [1e-3, 1e-3]]
    walled = PolygonMap.from_outlines(outline, wall)
    assert float(walls_met(walled, scan_of(exact), POSE)) < clear - 0.005
    # A ray that ends on that wall is better off than one that is said to pass it.
    stopped = cast(walled, POSE, SENSOR.bearings, SENSOR.range_max)
    assert float(jnp.min(stopped - exact)) < -1
    found = float(walls_met(walled, scan_of(stopped), POSE))
    assert found > float(walls_met(walled, scan_of(exact), POSE))


def test_rays_that_say_nothing_meet_no_walls(exact):
    keep = jnp.arange(180) % 3 > 0
    garbage = jnp.where(keep, exact, 0.1 + 0.01 * jnp.arange(180))
    one = walls_met(l_room(), scan_of(exact, keep), POSE)
    other = walls_met(l_room(), scan_of(garbage, keep), POSE)
    np.testing.assert_array_equal(one, other)
    for ranges, valid in ((jnp.full(180, 2.0), False), (jnp.full(180, 99.0), True)):
        assert np.isfinite(walls_met(l_room(), scan_of(ranges, valid), POSE))


def test_on_walls_under_jit_and_vmap(exact):
    world, scan = l_room(), scan_of(exact)
    poses = POSE[None] + jnp.linspace(-0.3, 0.3, 5)[:, None]
    many = jax.jit(jax.vmap(on_walls, (None, None, 0)))(world, scan, poses)
    one = [walls_met(world, scan, pose) for pose in poses]
    np.testing.assert_allclose(many, one, atol=1e-5)
    np.testing.assert_allclose(on_walls(world, scan, poses[0]), one[0], atol=1e-5)
