"""Each stage where its answer is known: on position, with the heading, without noise."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.alignment import Candidates, theseus, translate
from fsmsm_jax.evaluation import (
    caer_pairs,
    close_half_scans,
    draw_cases,
    heading_candidates,
    noisy,
    rotation_row,
    translation_walk,
)
from tests.oracles.raycast import cast_walls
from tests.worlds import CENTRE

COUNT = 16
KEY = jax.random.key(7)


@pytest.fixture(scope="module")
def cases():
    """Smooth rooms: from most places the whole wall is in sight."""
    phase = np.random.default_rng(4).uniform(0, 6, (COUNT, 2))
    a = np.linspace(-np.pi / 2, np.pi / 2, 361)
    ranges = 3 + 0.9 * np.sin(2 * a + phase[:, :1]) + 0.3 * np.sin(5 * a + phase[:, 1:])
    worlds = close_half_scans(ranges, np.tile([*CENTRE, 0.4], (COUNT, 1)))
    return draw_cases(jax.random.key(1), worlds.outlines, worlds.poses)


first_principles = partial(theseus, method="first_principles")


def by_the_oracle(cases, index, pose, rays):
    outline = np.asarray(cases.outlines[index], float)
    a = pose[2] + np.linspace(-np.pi, np.pi, rays, endpoint=False)
    return cast_walls(outline, np.roll(outline, -1, axis=0), pose[:2], a, 1e3)


def test_method_gets_both_scans_and_its_answers_are_measured_from_the_truth(cases):
    """A method that says what it was given: here the correction is the shortest ray."""

    def shortest(ranges, fine):
        ahead = 2 * jnp.pi / fine.size * jnp.argmin(fine) - jnp.pi
        return Candidates(ahead[None], jnp.min(fine)[None], jnp.min(ranges)[None])

    few = jax.tree.map(lambda a: a[:3], cases)
    found = heading_candidates(KEY, few, shortest, 2, rays=90, turn=0.0)
    for index, pose in enumerate(np.asarray(few.true, float)):
        fine = by_the_oracle(few, index, pose, 360)
        assert found.similarity[index, 0] == pytest.approx(fine.min(), abs=1e-4)
        assert found.caer[index, 0] == pytest.approx(fine[::4].min(), abs=1e-4)
        a = np.linspace(-np.pi, np.pi, 360, endpoint=False)
        assert np.abs(a[np.argmin(fine)] - found.error[index, 0]) < 0.02
    turned = heading_candidates(KEY, few, shortest, 2, rays=90, turn=0.5)
    assert np.abs(geometry.wrap(turned.error - found.error)).max() < 0.02  # walls stay
    assert not np.allclose(turned.error, found.error)


def test_candidates_are_a_fraction_of_a_ray_apart(cases):
    found = heading_candidates(KEY, cases, theseus, 2, rays=90)
    assert found.error.shape == found.similarity.shape == found.caer.shape == (COUNT, 4)
    gamma = 2 * np.pi / 90
    apart = np.mod(np.diff(found.error, axis=1), gamma)
    np.testing.assert_allclose(apart, gamma / 4, atol=1e-5)


@pytest.mark.parametrize(("degree", "by"), [(0, "similarity"), (3, "caer")])
def test_fourier_mellin_is_right_to_a_fraction_of_a_ray(cases, degree, by):
    row = rotation_row(KEY, cases, theseus, degree, by=by)
    bound = math.pi / 360 / 2**degree
    assert row.error.mean.value < bound
    assert row.within.value == np.mean(np.abs(row.errors) <= bound + 1e-6) > 0.8
    assert np.any(row.errors > 0)
    assert np.any(row.errors < 0)  # signed


def test_unknown_choice(cases):
    with pytest.raises(ValueError, match="by must be"):
        rotation_row(KEY, cases, by="luck")


def test_first_principles_errs_with_the_noise_and_less_with_more_rays(cases):
    error = lambda **options: rotation_row(KEY, cases, first_principles, **options)
    exact = error().error.mean.value
    ranges = error(sigma_R=0.1).error.mean.value
    fine = error(sigma_R=0.1, rays=1440).error.mean.value
    map_too = error(sigma_R=0.1, sigma_M=0.2).error.mean.value
    assert exact < 0.02
    assert exact < fine < ranges < map_too


def test_off_position_similarity_chooses_worse(cases):
    """Remark XVI."""
    ask = lambda offset: heading_candidates(
        KEY, cases, theseus, 3, turn=0.5, offset=offset
    )

    def chosen(found):
        best = np.argmax(found.similarity, axis=1)
        return np.mean(np.abs(found.error)[np.arange(COUNT), best])

    on, off = ask(0.0), ask(0.2)
    assert chosen(off) > 5 * chosen(on)
    assert float(on.similarity.max()) <= 1
    assert float(on.similarity.mean()) > float(off.similarity.mean())


def test_the_walk_is_translates(cases):
    path = translation_walk(cases, 30)
    assert path.position.shape == path.caer.shape == (COUNT, 31)
    away = np.linalg.norm((cases.initial - cases.true)[:, :2], axis=1)
    np.testing.assert_allclose(path.position[:, 0], away, atol=1e-5)
    assert np.median(path.position[:, -1]) < 1e-3
    assert np.median(path.position[:, 4] / path.position[:, 0]) < 0.35
    assert np.mean(path.caer[:, 10] < path.caer[:, 0]) > 0.9
    start = cases.initial.at[:, 2].set(cases.true[:, 2])
    after = jax.vmap(lambda w, r, p: translate(w, r, p, 4, range_max=1e3).pose)(
        *noisy(cases), start
    )
    expected = np.linalg.norm((after - cases.true)[:, :2], axis=1)
    np.testing.assert_allclose(path.position[:, 4], expected, atol=1e-4)


def test_noise_limits_the_walk(cases):
    last = lambda *sigmas: float(
        np.median(translation_walk(cases, 30, *sigmas).position[:, -1])
    )
    assert last() < last(0.02) < last(0.2) < 0.1
    assert last(0.0, 0.05) > last()


def test_caer_of_equal_poses_is_the_noise(cases):
    equal = caer_pairs(KEY, cases, 40, 0.05, offset=0.0, turn=0.0)
    np.testing.assert_array_equal(equal.position, 0)
    np.testing.assert_array_equal(equal.orientation, 0)
    expected = 0.05 * math.sqrt(2 / math.pi)  # E|N(0, σ)|
    assert np.mean(equal.caer) == pytest.approx(expected, rel=0.03)
    assert np.all(equal.inside)
    exact = caer_pairs(KEY, cases, 40, offset=0.0, turn=0.0)
    assert np.median(exact.caer) < 1e-5
    other = equal.caer[:COUNT] - equal.caer[COUNT : 2 * COUNT]  # same cases, new noise
    assert np.all(np.abs(other) > 0)


def test_caer_grows_with_the_error_of_the_pose(cases):
    pairs = caer_pairs(KEY, cases, 300)
    assert pairs.caer.shape == (300,)
    assert float(pairs.position.max()) <= 0.2 * math.sqrt(2) + 1e-5
    assert float(pairs.orientation.max()) <= math.pi / 4 + 1e-5
    assert float(pairs.orientation.max()) > 0.7
    size = np.hypot(pairs.position, pairs.orientation)
    assert np.corrcoef(size, pairs.caer)[0, 1] > 0.7
    again = caer_pairs(KEY, cases, 300)
    np.testing.assert_array_equal(pairs.caer, again.caer)
    assert len(np.unique(pairs.caer)) == 300


def test_pairs_outside_the_map_are_marked(cases):
    pairs = caer_pairs(KEY, cases, 100, offset=20.0)
    far = np.asarray(pairs.position) > 12
    assert far.any()
    assert not np.any(np.asarray(pairs.inside)[far])
    near = caer_pairs(KEY, cases, 100, offset=0.1)
    assert np.all(near.inside)
