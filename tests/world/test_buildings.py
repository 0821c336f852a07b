"""Procedural buildings: deterministic, connected, closed, and of the size asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.buildings import office

SHAPES = [
    (0, 6.0, 6.0, 0.05),
    (1, 6.0, 31.0, 0.1),
    (2, 40.0, 25.0, 0.05),
    (3, 23.7, 17.3, 0.2),
    (4, 90.0, 70.0, 0.1),
]


@pytest.fixture(
    scope="module", params=SHAPES, ids=lambda s: f"seed{s[0]}-{s[1]}x{s[2]}"
)
def shape_and_world(request):
    return request.param, office(*request.param)


def test_size_and_origin(shape_and_world):
    (_, width, height, resolution), world = shape_and_world
    margin = 0.5
    assert world.cells.shape == (
        round((height + 2 * margin) / resolution),
        round((width + 2 * margin) / resolution),
    )
    np.testing.assert_allclose(world.origin, [-margin, -margin, 0.0])
    # The outer wall starts outside the building and nothing free lies beyond it.
    rows, columns = np.nonzero(np.asarray(world.free))
    x, y = (np.stack([columns, rows]) + 0.5) * resolution - margin
    assert x.min() > 0
    assert x.max() < width
    assert y.min() > 0
    assert y.max() < height


def test_only_free_occupied_unknown(shape_and_world):
    _, world = shape_and_world
    assert set(np.unique(world.cells)) == {-1, 0, 100}


def test_free_space_is_connected_and_enough(shape_and_world):
    _, world = shape_and_world
    free = np.asarray(world.free)
    assert ndimage.label(free)[1] == 1
    assert 0.35 < free.mean() < 0.85


def test_free_never_touches_unknown_outside(shape_and_world):
    """The wall is closed: growing the outside through unknown space meets no free cell."""
    _, world = shape_and_world
    unknown = np.asarray(world.unknown)
    labels, _ = ndimage.label(unknown)
    outside = labels == labels[0, 0]
    assert outside[0].all()
    assert outside[:, -1].all()
    assert not (ndimage.binary_dilation(outside, np.ones((3, 3))) & world.free).any()


SEEN = jax.jit(jax.vmap(raycast, in_axes=(None, 0, None, None)))
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, 360, endpoint=False)


def poses_somewhere(world, count, clearance):
    """Random poses in free space, so far from the nearest wall [m]."""
    rows, columns = np.nonzero(np.asarray(world.distance * world.free) > clearance)
    pick = np.random.default_rng(0).integers(len(rows), size=count)
    cells = np.stack([columns[pick], rows[pick]], axis=-1) + 0.5
    return jnp.pad(world.to_map(jnp.asarray(cells, float)), ((0, 0), (0, 1)))


@pytest.mark.parametrize("seed", range(4))
def test_rays_never_escape(seed):
    world = office(seed)
    ranges = SEEN(world, poses_somewhere(world, 40, 0.0), BEARINGS, 500.0)
    assert ranges.max() < np.hypot(40.0, 25.0)


def test_same_seed_same_building():
    np.testing.assert_array_equal(office(7).cells, office(7).cells)


def test_seeds_differ():
    worlds = [np.asarray(office(seed, 20.0, 15.0).cells) for seed in range(6)]
    for k, world in enumerate(worlds):
        for other in worlds[:k]:
            assert (world != other).mean() > 0.1


@pytest.mark.parametrize("seed", range(12))
def test_most_of_the_floor_is_reached(seed):
    """Doors reach the rooms: little but courtyards and recesses is lost to the flood."""
    bare = office(seed, 30.0, 20.0, 0.1, furnished=False)
    furnished = office(seed, 30.0, 20.0, 0.1)
    assert bare.free.mean() > 0.45
    assert furnished.free.sum() > 0.75 * bare.free.sum()
    # Without furniture the walls alone are occupied: a building is mostly floor.
    assert bare.occupied.mean() < 0.2


def test_doors_are_wide_enough_for_a_robot():
    """A disc of 0.5 m can still drive almost everywhere."""
    world = office(0, furnished=False)
    wide = np.asarray(world.free) & (np.asarray(world.distance) > 0.25)
    labels, _ = ndimage.label(wide)
    sizes = np.bincount(labels.ravel())[1:]
    assert sizes.max() > 0.99 * sizes.sum()


def test_rooms_look_different():
    """Ranges sorted, so blind to heading, tell places a room apart from each other."""
    world = office(0)
    poses = poses_somewhere(world, 40, 0.5)
    scans = np.sort(SEEN(world, poses, BEARINGS, 30.0))
    apart = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=-1) > 3
    differ = np.abs(scans[:, None] - scans).mean(axis=-1)
    assert differ[apart].min() > 0.05


def test_unknown_is_passed_on():
    world = office(0, 8.0, 8.0, unknown="opaque")
    assert world.clearance[1, 1] == 0
    with pytest.raises(ValueError, match="unknown"):
        office(0, 8.0, 8.0, unknown="maybe")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 5.9}, "6 m or more"),
        ({"height": -25.0}, "6 m or more"),
        ({"width": float("nan")}, "6 m or more"),
        ({"height": float("inf")}, "6 m or more"),
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": 0.21}, "resolution"),
        ({"resolution": float("nan")}, "resolution"),
        ({"width": 3000.0, "height": 3000.0}, "coarser"),
    ],
)
def test_silly_sizes(arguments, message):
    with pytest.raises(ValueError, match=message):
        office(**arguments)
