"""Resamplers against plain loops, dead particles, expectations; KLD against its paper."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.resampling import (
    Kld,
    kld_count,
    occupied_bins,
    residual_systematic,
    systematic,
)

RESAMPLERS = {"systematic": systematic, "residual": residual_systematic}


def comb(weights, count, offset):
    """Tooth by tooth, in float64."""
    heap = np.cumsum(np.asarray(weights, float))
    teeth = (np.arange(count) + offset) / count * heap[-1]
    return [int(np.argmax(heap > tooth)) for tooth in teeth]


def uneven(seed, n=50):
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0, 1, n) ** 4
    weights[rng.uniform(size=n) < 0.3] = 0
    return weights


@pytest.fixture(params=RESAMPLERS)
def resampler(request):
    return RESAMPLERS[request.param]


@pytest.fixture(params=[False, True], ids=["eager", "jit"])
def drawn(request, resampler):
    jitted = jax.jit(resampler, static_argnums=2)
    return jitted if request.param else resampler


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [1, 7, 50, 173])
def test_systematic_is_a_comb(seed, count):
    weights, key = uneven(seed), jax.random.key(seed)
    offset = float(jax.random.uniform(key))
    found = systematic(key, jnp.asarray(weights, float), count)
    assert found.tolist() == comb(weights, count, offset)


@pytest.mark.parametrize("seed", range(5))
def test_residual_gives_the_whole_copies_first(seed):
    weights, key, count = uneven(seed), jax.random.key(seed), 83
    share = weights / weights.sum() * count
    sure = np.floor(share).astype(int)
    rest = comb(share - sure, count - sure.sum(), float(jax.random.uniform(key)))
    expected = sure + np.bincount(rest, minlength=len(weights))
    found = residual_systematic(key, jnp.asarray(weights, float), count)
    assert np.bincount(found, minlength=len(weights)).tolist() == expected.tolist()


def test_copies_are_the_share_rounded(drawn):
    weights = uneven(3, 200)
    share = weights / weights.sum() * 500
    for seed in range(20):
        found = drawn(jax.random.key(seed), jnp.asarray(weights, float), 500)
        copies = np.bincount(found, minlength=200)
        assert copies.sum() == 500
        assert np.all(np.abs(copies - share) < 1 + 1e-3)


def test_the_dead_are_never_drawn(drawn):
    """2000 particles of weights that float32 does not add up to 1; five dead at the end.

    Dead ones in the middle and in front, too. Counted over offsets near 1.
    """
    n = 2000
    weights = np.random.default_rng(1).uniform(0, 1, n).astype(np.float32)
    weights /= weights.sum()
    dead = np.r_[0:3, 700:720, 1500, n - 5 : n]
    weights[dead] = 0
    for seed in range(60):
        found = np.asarray(drawn(jax.random.key(seed), jnp.asarray(weights), n))
        assert not np.isin(found, dead).any()
        assert ((found >= 0) & (found < n)).all()


@pytest.mark.parametrize("offset", [0.0, 0.5, 1 - 2**-24])
@pytest.mark.parametrize("resampler", RESAMPLERS.values(), ids=RESAMPLERS)
def test_the_dead_stay_dead_at_extreme_offsets(monkeypatch, resampler, offset):
    monkeypatch.setattr(
        jax.random, "uniform", lambda key, dtype: jnp.asarray(offset, dtype)
    )
    for seed in range(6):
        weights = uneven(seed, 3000).astype(np.float32)
        weights[-5:] = 0
        found = np.asarray(resampler(jax.random.key(0), jnp.asarray(weights), 3000))
        assert np.all(weights[found] > 0)


def test_expectation(drawn):
    """Over 200 keys each particle is drawn in proportion to its weight."""
    weights = jnp.asarray([0.0, 1.0, 2.5, 0.25, 0.0, 3.0, 0.01])
    keys = jax.random.split(jax.random.key(5), 200)
    found = np.stack([drawn(key, weights, 10) for key in keys])
    copies = np.stack([np.bincount(f, minlength=7) for f in found])
    share = np.asarray(weights / weights.sum()) * 10
    error = copies.std(axis=0) / np.sqrt(len(keys)) + 1e-3
    assert np.all(np.abs(copies.mean(axis=0) - share) < 4 * error)


def test_one_survivor(drawn):
    weights = jnp.zeros(40).at[17].set(1e-30)
    assert set(drawn(jax.random.key(0), weights, 12).tolist()) == {17}


@pytest.mark.parametrize("bad", [0.0, jnp.nan, jnp.inf])
def test_without_usable_weights_all_count_alike(drawn, bad):
    weights = jnp.zeros(6).at[2].set(bad)
    assert drawn(jax.random.key(0), weights, 6).tolist() == list(range(6))


def test_a_traced_number_of_draws(resampler):
    weights = jnp.asarray(uneven(8), float)
    some = jax.jit(lambda key, drawn: resampler(key, weights, 64, drawn))
    for drawn in (1, 9, 64):
        key = jax.random.key(drawn)
        found = some(key, drawn)
        assert found[:drawn].tolist() == resampler(key, weights, drawn).tolist()
        assert np.all(weights[found] > 0)


def test_vmap_is_a_loop(resampler):
    keys = jax.random.split(jax.random.key(0), 5)
    weights = jnp.stack([jnp.asarray(uneven(seed), float) for seed in range(5)])
    together = jax.vmap(resampler, (0, 0, None))(keys, weights, 31)
    one_by_one = [resampler(k, w, 31) for k, w in zip(keys, weights, strict=True)]
    assert np.array_equal(together, np.stack(one_by_one))


def test_float64_draws_the_same():
    with jax.enable_x64(True):
        weights = jnp.asarray(uneven(2), jnp.float64)
        key = jax.random.key(4)
        offset = float(jax.random.uniform(key, dtype=jnp.float64))
        assert systematic(key, weights, 90).tolist() == comb(weights, 90, offset)


def test_all_have_one_signature():
    names = [list(inspect.signature(f).parameters) for f in RESAMPLERS.values()]
    assert names[0] == names[1] == ["key", "weights", "count", "drawn"]


# KLD-sampling


def fox(poses, kld):
    """Table 1 of the paper, particle by particle."""
    seen, count = set(), 0
    metres, radians = kld.bin_size
    for x, y, theta in poses:
        count += 1
        turn = (theta + np.pi) % (2 * np.pi)
        seen.add((x // metres, y // metres, turn // radians))
        k, wanted = len(seen), 0.0
        if k > 1:
            a = 2 / (9 * (k - 1))
            wanted = (k - 1) / (2 * kld.error)
            wanted *= (1 - a + np.sqrt(a) * kld.quantile) ** 3
        if count >= max(wanted, kld.fewest):
            return count
    return count


@pytest.mark.parametrize("spread", [0.01, 0.3, 1.0, 5.0, 100.0])
@pytest.mark.parametrize("seed", range(3))
def test_kld_counts_as_in_the_paper(seed, spread):
    kld = Kld(fewest=100, most=2000, error=0.05)
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, spread, (2000, 3)) + [-12.3, 40.1, 3.0]
    poses = poses.astype(np.float32).astype(float)
    found = kld_count(jnp.asarray(poses, float), kld)
    assert abs(int(found) - fox(poses, kld)) <= 2  # float32 at a bin's edge
    assert int(found) == int(jax.jit(kld_count)(jnp.asarray(poses, float), kld))


def test_one_bin_asks_for_the_fewest_and_many_for_all():
    kld = Kld(fewest=30, most=400)
    rng = np.random.default_rng(0)
    together = jnp.asarray(rng.uniform(0.01, 0.02, (400, 3)) + [7.0, -3.0, 0.0], float)
    apart = jnp.asarray(rng.uniform(-90, 90, (400, 3)), float)
    assert int(kld_count(together, kld)) == 30
    assert int(kld_count(apart, kld)) == 400


def test_bins_are_counted():
    rng = np.random.default_rng(4)
    poses = rng.uniform([-30, 10, -3.1], [-20, 25, 3.1], (500, 3)).astype(np.float32)
    kld = Kld()
    cells = np.floor(
        np.column_stack([poses[:, :2] / 0.5, (poses[:, 2] + np.pi) / 0.17453293])
    )
    found = int(occupied_bins(jnp.asarray(poses), kld))
    assert abs(found - len(np.unique(cells, axis=0))) <= 1


def test_bad_numbers_of_particles():
    with pytest.raises(ValueError, match="fewest ≤ most"):
        Kld(fewest=500, most=200)
