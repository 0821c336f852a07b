"""FSMSM: what must hold of every match; the C++'s numbers are in test_golden.py."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import geometry
from fsmsm_jax.alignment import FsmsmConfig, fsmsm
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import PolygonMap, buildings
from tests.worlds import CENTRE, l_room, square_room, star

RAYS = 180
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, RAYS, endpoint=False)
METHODS = ["fourier_mellin", "procrustes", "first_principles"]


def default(orientation="fourier_mellin"):
    first = orientation == "first_principles"
    return FsmsmConfig(orientation=orientation, memory="pose" if first else "heading")


def starts(truth, seed=0, offset=0.2, turn=np.pi / 4):
    rng = np.random.default_rng(seed)
    away = rng.uniform(-1, 1, truth.shape) * [offset, offset, turn]
    return jnp.asarray(truth) + jnp.asarray(away, float)


def truths(count, seed=1):
    rng = np.random.default_rng(seed)
    xy = CENTRE + rng.uniform(-0.3, 0.3, (count, 2))
    return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])


def stacked(worlds):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)


def in_24_walls(room):
    """The same room, its four walls in pieces: the shape of a star, one compile."""
    along = np.linspace(0, 1, 6, endpoint=False)[None, :, None]
    start, end = (np.asarray(a)[:, None] for a in (room.start, room.end))
    corners = np.reshape(start + along * (end - start), (24, 2))
    return PolygonMap.from_outlines(corners)


@jax.jit
def cast(worlds, poses, bearings=BEARINGS):
    return jax.vmap(raycast, (0, 0, None))(worlds, poses, bearings)


def errors(found, truth):
    apart = np.asarray(found) - truth
    turn = (apart[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.hypot(apart[:, 0], apart[:, 1]), np.abs(turn)


run = jax.jit(fsmsm)
STARS = stacked([star(seed) for seed in range(16)])
TRUTH = truths(16)


@pytest.mark.parametrize("orientation", METHODS)
def test_finds_the_pose_without_noise(orientation):
    found = run(
        STARS, cast(STARS, jnp.asarray(TRUTH)), starts(TRUTH), default(orientation)
    )
    position, turn = errors(found.pose, TRUTH)
    right = (position < 1e-3) & (turn < 1e-3)
    # One harmonic is not all of a jagged room: first principles takes some for others.
    assert right.mean() >= (0.75 if orientation == "first_principles" else 1.0)
    assert found.converged.all()
    assert found.caer_per_ray[right].max() < 1e-3


def test_default_reaches_a_tenth_of_the_noise():
    """σ √(2/N) = 5 mm at σ = 0.05 m and 180 rays is what a round room would allow."""
    rng = np.random.default_rng(3)
    real = cast(STARS, jnp.asarray(TRUTH)) + 0.05 * rng.standard_normal((16, RAYS))
    found = run(STARS, jnp.asarray(real, float), starts(TRUTH), default())
    position, _ = errors(found.pose, TRUTH)
    assert np.median(position) < 1.5 * 0.05 * np.sqrt(2 / RAYS)


def test_block_and_batch_do_not_matter():
    real, start = cast(STARS, jnp.asarray(TRUTH)), starts(TRUTH)
    whole = run(STARS, real, start, default())
    small = jax.jit(partial(fsmsm, block=3))(STARS, real, start, default())
    np.testing.assert_allclose(small.pose, whole.pose, atol=1e-5)
    np.testing.assert_array_equal(small.steps, whole.steps)
    others = jax.tree.map(lambda a: jnp.roll(a, 5, axis=0), (STARS, real, start))
    beside = run(*others, default())
    np.testing.assert_allclose(beside.pose, jnp.roll(whole.pose, 5, axis=0), atol=1e-5)


def test_one_world_serves_many_scans():
    room, truth = star(4), truths(16, seed=8)
    copied = stacked([room] * 16)
    real = cast(copied, jnp.asarray(truth))
    shared = run(room, real, starts(truth), default())
    copies = run(copied, real, starts(truth), default())
    np.testing.assert_allclose(shared.pose, copies.pose, atol=1e-5)
    assert errors(shared.pose, truth)[0].max() < 1e-3


def test_moves_with_the_world():
    room, truth = star(4), truths(16, seed=8)
    real = cast(stacked([room] * 16), jnp.asarray(truth))
    # By translation only: the box around the start has sides along x and y.
    shift = jnp.array([30.0, -11.0])
    moved = PolygonMap(room.start + shift[None], room.end + shift[None])
    here = run(room, real, starts(truth), default())
    there = run(moved, real, starts(truth).at[:, :2].add(shift), default())
    np.testing.assert_allclose(
        there.pose[:, :2] - shift[None], here.pose[:, :2], atol=1e-4
    )
    np.testing.assert_allclose(there.pose[:, 2], here.pose[:, 2], atol=1e-4)


def test_partial_view_by_a_mask():
    rng = np.random.default_rng(5)
    mask = jnp.broadcast_to(jnp.abs(BEARINGS) < np.pi / 2, (16, RAYS))
    real = cast(STARS, jnp.asarray(TRUTH))
    real = jnp.where(mask, real, rng.uniform(0, 9, (16, RAYS)))  # must not matter
    start = starts(TRUTH, offset=0.1, turn=0.3)
    found = run(STARS, real, start, default(), mask=mask)
    position, turn = errors(found.pose, TRUTH)
    assert np.mean((position < 1e-3) & (turn < 1e-3)) >= 14 / 16
    with pytest.raises(ValueError, match="fourier_mellin"):
        fsmsm(STARS, real, start, default("procrustes"), mask=mask)


def test_grid_and_polygons_by_the_same_code():
    world = buildings.office(0)
    rows, columns = np.nonzero(np.asarray(world.free & (world.distance > 0.6)))
    pick = np.random.default_rng(2).integers(0, len(rows), 8)
    xy = world.to_map(jnp.stack([columns[pick], rows[pick]], axis=-1) + 0.5)
    heading = np.random.default_rng(3).uniform(-3, 3, 8)
    truth = np.column_stack([xy, heading])
    one = lambda pose: raycast(world, pose, BEARINGS)
    real = jax.jit(partial(jax.lax.map, one))(jnp.asarray(truth, float))
    noise = 0.02 * np.random.default_rng(4).standard_normal(real.shape)
    found = run(world, real + jnp.asarray(noise, float), starts(truth), default())
    position, turn = errors(found.pose, truth)
    # Half a cell of 0.05 m; the slope of a blurred grid bends a little at corners.
    assert np.median(position) < 0.025
    assert np.median(turn) < 0.01


def test_a_square_room_is_not_turned_into_its_twin():
    """Four headings fit a square from its middle; only one lies in the box."""
    room, truth = in_24_walls(square_room()), truths(16, seed=8)
    worlds = stacked([room] * 16)
    start = starts(truth, turn=0.3)
    found = run(worlds, cast(worlds, jnp.asarray(truth)), start, default())
    position, turn = errors(found.pose, truth)
    assert found.converged.all()
    assert position.max() < 1e-3
    assert turn.max() < 1e-3


def test_leaving_the_map_is_recovered_from_or_reported():
    """From 0.3 m outside a wall, half of the box lies inside."""
    corners = np.array([[0, 0], [4, 0], [4, 3], [0, 3]]) + CENTRE
    room = in_24_walls(PolygonMap.from_outlines(corners))
    truth = np.tile([*(CENTRE + [0.4, 1.0]), 0.3], (16, 1))
    real = cast(stacked([room] * 16), jnp.asarray(truth))
    outside = jnp.asarray(truth - [[0.6, 0, 0]], float)
    config = FsmsmConfig(box=(0.8, 0.5))
    found = run(room, real, outside, config)
    assert found.recoveries[0] > 0
    assert found.converged[0]
    assert errors(found.pose, truth)[0][0] < 1e-3
    hopeless = run(room, real, outside - jnp.array([[20.0, 0, 0]]), config)
    assert not hopeless.converged[0]
    assert hopeless.recoveries[0] == config.max_recoveries
    assert jnp.isfinite(hopeless.pose).all()


def test_caer_limit_starts_again_and_gives_up():
    config = FsmsmConfig(caer_limit=1e-9, max_recoveries=2)
    real = cast(STARS, jnp.asarray(TRUTH)) + 0.1
    found = run(STARS, real, starts(TRUTH), config, key=jax.random.key(3))
    assert not found.converged.any()
    assert (found.recoveries == 2).all()


def test_same_key_same_answer():
    config = FsmsmConfig(caer_limit=1e-9, max_recoveries=2)
    real, start = cast(STARS, jnp.asarray(TRUTH)) + 0.1, starts(TRUTH)
    one, two, other = (
        run(STARS, real, start, config, key=jax.random.key(seed)) for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(one.pose, two.pose)
    assert (one.pose != other.pose).any()


def test_counts_its_scans():
    """ν = 1: 2 in the fine cast, 6 poses rehearsed twice, 3 walked; ν = 2: 4, 12, 5."""
    real = cast(STARS, jnp.asarray(TRUTH))
    found = run(STARS, real, jnp.asarray(TRUTH, float), default())
    quick = found.recoveries == 0
    fewest = (2 + 12 + 3) + (4 + 12 + 5) + 6 + 1
    assert (found.scans[quick] >= fewest).all()
    assert found.scans.min() < 4 * fewest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": (1, 2, 3)}, "one number of translations each"),
        ({"levels": (), "translations": ()}, "one number of translations each"),
        ({"levels": (1, 40)}, "0..10"),
        ({"orientation": "magic"}, "choose from fourier_mellin"),
        ({"memory": "none"}, "'heading', 'turn' or 'pose'"),
    ],
)
def test_bad_settings(change, message):
    with pytest.raises(ValueError, match=message):
        FsmsmConfig(**change)


def test_floats_are_leaves():
    """Sweeping a number must not trace anew, so it does not compile either."""
    traces = []

    @jax.jit
    def match(config, start):
        traces.append(1)
        return fsmsm(l_room(), REAL, start, config)

    REAL = raycast(l_room(), jnp.asarray(TRUTH[0], float), BEARINGS)[None]
    for limit in (0.1, 0.2, 0.3):
        config = FsmsmConfig.published("fourier_mellin", limit, 0.05)
        jax.eval_shape(match, config, starts(TRUTH[:1]))
    assert len(traces) == 1


def test_float32_is_near_float64():
    with jax.enable_x64(True):
        worlds = stacked([star(seed) for seed in range(16)])
        real = cast(worlds, jnp.asarray(TRUTH), jnp.asarray(BEARINGS, jnp.float64))
        fine = jax.jit(fsmsm)(worlds, real, jnp.asarray(starts(TRUTH)), default())
        assert fine.pose.dtype == jnp.float64
        fine = np.asarray(fine.pose)
    coarse = run(STARS, cast(STARS, jnp.asarray(TRUTH)), starts(TRUTH), default())
    assert coarse.pose.dtype == jnp.float32
    assert np.abs(geometry.wrap(jnp.asarray(coarse.pose - fine))).max() < 1e-3
