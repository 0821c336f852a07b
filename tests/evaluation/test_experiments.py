"""Tables of matchers whose answers are known: perfect, idle, lost, and merely steps."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment import translate
from fsmsm_jax.evaluation import (
    close_half_scans,
    degree_sweep,
    draw_cases,
    match_errors,
    match_row,
    match_table,
    range_limit_sweep,
)
from tests.worlds import CENTRE

COUNT = 11  # no multiple of a batch below


class Matched(NamedTuple):
    pose: Any
    converged: Any
    scans: Any
    steps: Any
    recoveries: Any


def answer(pose, scans=7):
    ones = np.ones(len(pose), int)
    return Matched(pose, ones > 0, scans * ones, 2 * ones, 0 * ones)


@pytest.fixture(scope="module")
def cases():
    ranges = (
        2
        + np.random.default_rng(2).uniform(0, 0.05, (COUNT, 1))
        + np.sin(np.linspace(0, 5, 181) + np.arange(COUNT)[:, None])
    )
    worlds = close_half_scans(ranges, np.tile([*CENTRE, 0.4], (COUNT, 1)))
    return draw_cases(jax.random.key(1), worlds.outlines, worlds.poses)


def perfect(cases):
    """Looks up which case it is asked about, and answers with the truth."""

    def match(worlds, ranges, poses):
        same = np.all(np.asarray(poses)[:, None] == np.asarray(cases.initial), axis=-1)
        assert np.all(same.sum(axis=1) == 1)
        return answer(cases.true[np.argmax(same, axis=1)])

    return match


def idle(worlds, ranges, poses):
    return answer(poses)


def lost(worlds, ranges, poses):
    return answer(jnp.full_like(poses, jnp.nan))


@jax.jit
def stepping(worlds, ranges, poses):
    walk = jax.vmap(lambda w, r, p: translate(w, r, p, 12, range_max=1000.0).pose)
    return walk(worlds, ranges, poses)


@pytest.mark.parametrize("batch", [1, 4, 64])
def test_the_perfect_matcher(cases, batch):
    rows = match_table(cases, perfect(cases), (0.01, 0.1), (0.0, 0.05), batch)
    assert [(row.sigma_R, row.sigma_M) for row in rows] == [
        (0.01, 0.0), (0.1, 0.0), (0.01, 0.05), (0.1, 0.05),
    ]  # fmt: skip
    for row in rows:
        assert row.n == COUNT
        assert row.success.value == row.converged.value == 1
        assert row.success.low < 0.8  # eleven cases prove little
        for spread in (row.position, row.orientation, row.pose):
            assert spread.median.value == spread.mean.value == spread.p90.value == 0
        assert row.scans.median.value == 7
        assert row.steps.mean.value == 2
        assert row.recoveries.value == 0


def test_the_idle_matcher(cases):
    row = match_row(cases, idle, batch=4)
    away = np.asarray(cases.initial - cases.true, float)
    away[:, 2] = (away[:, 2] + math.pi) % (2 * math.pi) - math.pi
    errors = row.errors
    np.testing.assert_allclose(errors.position, np.hypot(*away.T[:2]), atol=1e-5)
    np.testing.assert_allclose(errors.orientation, np.abs(away[:, 2]), atol=1e-5)
    np.testing.assert_allclose(errors.pose, np.linalg.norm(away, axis=1), atol=1e-5)
    np.testing.assert_array_equal(errors.pose, errors.before)
    assert row.success.value == 0
    expected = np.median(np.hypot(*away.T[:2]))
    assert row.position.median.value == pytest.approx(expected, abs=1e-5)
    assert row.pose.mean.low < row.pose.mean.value < row.pose.mean.high


def test_the_lost_matcher(cases):
    row = match_row(cases, lost)
    assert row.success.value == 0
    assert math.isnan(row.position.mean.value)
    assert math.isnan(row.orientation.median.value)


def test_success_is_of_the_pose_and_not_of_its_parts(cases):
    """Turned right but moved away: metres and radians add up as squares."""

    def match(worlds, ranges, poses):
        true = perfect(cases)(worlds, ranges, poses).pose
        return answer(true.at[:, 0].add(0.3))

    errors = match_errors(cases, match)
    np.testing.assert_allclose(errors.pose, 0.3, atol=1e-5)
    np.testing.assert_array_equal(errors.success, errors.before > 0.3)
    assert 0 < errors.success.mean() < 1


def test_batches_do_not_matter_and_have_one_shape(cases):
    shapes = []

    def match(worlds, ranges, poses):
        shapes.append((worlds.start.shape, ranges.shape, poses.shape))
        return answer(stepping(worlds, ranges, poses))

    together = match_errors(cases, match, 0.03, 0.02, batch=64)
    apart = match_errors(cases, match, 0.03, 0.02, batch=4)
    for one, other in zip(together, apart, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert [shape[2] for shape in shapes] == [(11, 3), (4, 3), (4, 3), (4, 3)]
    assert shapes[1][:2] == ((4, 360, 2), (4, 360))


def test_a_real_matcher_does_better_with_the_right_heading(cases):
    cases = cases._replace(initial=cases.initial.at[:, 2].set(cases.true[:, 2]))
    match = lambda *question: answer(stepping(*question))
    exact, noise = match_table(cases, match, (0.0, 0.1), (0.0,))
    assert exact.success.value == 1
    assert exact.position.median.value < 0.01
    assert exact.position.median.value < noise.position.median.value < 0.1


def test_the_matcher_sees_the_noise(cases):
    seen = []

    def match(worlds, ranges, poses):
        seen.append(
            (np.std(ranges - cases.ranges), np.std(worlds.start - cases.outlines))
        )
        return idle(worlds, ranges, poses)

    match_table(cases, match, (0.0, 0.1), (0.0, 0.05))
    np.testing.assert_allclose(
        seen, [(0, 0), (0.1, 0), (0, 0.05), (0.1, 0.05)], rtol=0.05
    )


def test_a_row_for_each_degree(cases):
    make = lambda degree: lambda w, r, poses: answer(poses, scans=2**degree)
    rows = degree_sweep(cases, make, range(4))
    assert [row.scans.median.value for row in rows] == [1, 2, 4, 8]


def test_short_sight(cases):
    made, longest = [], []

    def make(limit):
        made.append(limit)

        def match(worlds, ranges, poses):
            longest.append(float(ranges.max()))
            return answer(poses)

        return match

    limits = [1.5, 2.5, 50.0]
    rows = range_limit_sweep(cases, make, limits, sigma_R=0.0)
    assert made == limits
    np.testing.assert_allclose(longest[:2], limits[:2])
    assert longest[2] == float(cases.ranges.max())
    for row, limit in zip(rows, limits, strict=True):
        expected = np.mean(np.asarray(cases.ranges) < np.float32(limit), axis=1)
        np.testing.assert_allclose(row.errors.in_range, expected, atol=1e-6)
    assert 0 < rows[0].errors.in_range.mean() < rows[1].errors.in_range.mean() < 1


def test_nothing_to_match(cases):
    with pytest.raises(ValueError, match="nothing to match"):
        match_row(jax.tree.map(lambda a: a[:0], cases), idle)
