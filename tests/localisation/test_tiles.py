"""A map cut in tiles: nothing is lost, nothing comes round, nothing is kept twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import AtlasConfig, build_atlas, tiles
from fsmsm_jax.localisation.lattice import lattice_over
from fsmsm_jax.localisation.shells import bins
from fsmsm_jax.localisation.tiles import cut, likelihood_spectra
from tests.oracles.localisation import distance_to_walls
from tests.worlds import l_room, random_grid

SOFTNESS = 0.4


def masks():
    """Lattices of all kinds and reaches: (allowed, reach)."""
    rng = np.random.default_rng(0)
    for shape, share, reach in (
        ((1, 1), 1.0, 1),
        ((3, 200), 0.5, 4),
        ((97, 41), 0.3, 12),
        ((300, 260), 0.0005, 19),  # a few nodes here and there
        ((150, 170), 0.8, 19),
        ((40, 30), 0.5, 90),  # farther than the largest of the quick sides
    ):
        allowed = rng.random(shape) < share
        allowed[rng.integers(shape[0]), rng.integers(shape[1])] = True
        yield allowed, reach
    ring = np.ones((600, 640), bool)  # corridors around a courtyard
    ring[10:-10, 10:-10] = False
    yield ring, 10


LATTICES = pytest.mark.parametrize(("allowed", "reach"), [*masks()])


@LATTICES
def test_every_allowed_node_is_in_one_tile(allowed, reach):
    found = cut(allowed, reach)
    rows, columns = allowed.shape
    core = found.allowed.shape[1]
    times = np.zeros((rows + core, columns + core), int)
    for (row, column), tile in zip(found.corner, found.allowed, strict=True):
        times[row : row + core, column : column + core] += tile
    np.testing.assert_array_equal(times[:rows, :columns], allowed)
    assert times.sum() == allowed.sum()  # and none lies beyond the lattice


@LATTICES
def test_end_points_stay_inside_their_tile(allowed, reach):
    """Those of a core's outermost nodes, with the nodes around them that they vote for.

    At any angle and up to the very reach; else the transform would bring them round.
    """
    found = cut(allowed, reach)
    core = found.allowed.shape[1]
    assert found.side == core + 2 * found.rim
    assert core >= 1
    angles = np.append(np.linspace(-np.pi, np.pi, 721), np.pi / 2 * np.arange(-2, 3))
    along = np.floor(reach * np.cos(angles))
    assert found.rim + along.min() >= 0
    assert found.rim + core - 1 + along.max() + 1 <= found.side - 1


@LATTICES
def test_spare_tiles_are_empty_and_others_are_not(allowed, reach):
    found = cut(allowed, reach)
    anyone = found.allowed.any(axis=(1, 2))
    used = int(anyone.sum())
    assert anyone[:used].all()
    assert len(found.corner) == len(found.allowed) == tiles.bucket(used)
    assert len(np.unique(found.corner[:used], axis=0)) == used


@LATTICES
def test_no_other_side_is_less_work(allowed, reach):
    """Work: nodes of all tiles where anyone may stand, of sides mostly core."""
    found = cut(allowed, reach)
    rim = reach + 1
    rows, columns = np.nonzero(allowed)
    work = {}
    for side in tiles._SIDES:
        if side >= 3 * rim:
            core = side - 2 * rim
            work[side] = len({*zip(rows // core, columns // core, strict=True)})
            work[side] *= side**2
    if work:
        assert work[found.side] == min(work.values())
    else:
        assert found.side >= 4 * rim


def test_a_courtyard_is_not_paid_for():
    *_, (ring, reach) = masks()
    found = cut(ring, reach)
    core = found.allowed.shape[1]
    blocks = -(-ring.shape[0] // core) * -(-ring.shape[1] // core)
    assert 0 < found.allowed.any(axis=(1, 2)).sum() < blocks


def fields_of(world, distance, reach, monkeypatch):
    """The tiles' fields by the transform and as they should be, and the nodes."""
    monkeypatch.setattr(tiles, "_SIDES", (24,))
    lattice, allowed = lattice_over(world, 0.25, 0.0)
    layout = cut(allowed, reach)
    assert (layout.side, layout.rim) == (24, reach + 1)
    corner, size = jnp.asarray(layout.corner), jnp.asarray(allowed.shape)
    spectra = likelihood_spectra(
        world, lattice, size, corner, SOFTNESS, side=layout.side, rim=layout.rim
    )
    assert spectra.shape == (len(corner), 24, 13)
    found = np.fft.irfft2(np.asarray(spectra), s=(24, 24))
    row, column = np.indices((24, 24)) - layout.rim
    rows = layout.corner[:, 0, None, None] + row
    columns = layout.corner[:, 1, None, None] + column
    nodes = np.asarray(lattice.to_map(jnp.asarray(rows), jnp.asarray(columns)), float)
    d = distance(nodes.reshape(-1, 2)).reshape(rows.shape)
    inside = (rows >= 0) & (rows < allowed.shape[0])
    inside &= (columns >= 0) & (columns < allowed.shape[1])
    wanted = np.where(inside, np.exp(-0.5 * (d / SOFTNESS) ** 2), 0.0)
    return found, wanted, inside


def test_fields_are_likelihoods_on_the_lattice_and_nought_beyond(monkeypatch):
    """In the rims too, where tiles overlap; by distances in float64.

    Transforms of 576 numbers up to 1 err by a few roundings of them.
    """
    world = l_room()
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    distance = lambda points: distance_to_walls(start, end, points)
    found, wanted, inside = fields_of(world, distance, 6, monkeypatch)
    assert (~inside).any()
    assert len(found) > 4
    np.testing.assert_allclose(found, wanted, atol=2e-6)


def test_fields_of_a_turned_grid(monkeypatch):
    """Forty metres from the origin float32 rounds by 4 µm, a hundred thousandth of σ."""
    grid = random_grid(3, 70, 100)
    distance = lambda points: np.asarray(grid.distance_at(jnp.asarray(points, float)))
    found, wanted, _ = fields_of(grid, distance, 6, monkeypatch)
    np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_bytes_are_those_that_are_held(monkeypatch):
    monkeypatch.setattr(tiles, "_SIDES", (24,))
    config = AtlasConfig(spacing=0.25, rays=16, reach=1.4)
    atlas = build_atlas(l_room(), config)
    _, allowed = lattice_over(l_room(), config.spacing, config.margin)
    layout, held = cut(allowed, 6), atlas.tiles
    arrays = held.spectra, held.corner, held.allowed, held.shells
    assert atlas.nbytes == sum(a.nbytes for a in arrays)
    assert layout.bytes(bins(config.reach)) == atlas.nbytes
    with jax.enable_x64(True):  # spectra are twice as large, the rest is not
        double = layout.bytes(bins(config.reach))
    assert double == atlas.nbytes + held.spectra.nbytes
    assert (held.side, held.core) == (24, 10)
    np.testing.assert_array_equal(held.corner, layout.corner)
    np.testing.assert_array_equal(held.allowed, layout.allowed)
