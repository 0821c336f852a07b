"""The campus: of the size asked for, connected, closed, and no two places alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.buildings import campus, office

OFFICE = 333284
SEEN = jax.jit(jax.vmap(raycast, in_axes=(None, 0, None, None)))
BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, 180, endpoint=False)


@pytest.fixture(scope="module")
def site():
    return campus(seed=2, free_area=25_000.0, resolution=0.2)


def free_area(world):
    return float(np.asarray(world.free).sum()) * float(world.resolution) ** 2


@pytest.mark.parametrize("seed", range(3))
def test_free_area_is_about_what_was_asked_for(seed):
    assert abs(free_area(campus(seed, 3_000.0, 0.2)) / 3_000 - 1) < 0.2


def test_the_larger_the_closer(site):
    assert abs(free_area(site) / 25_000 - 1) < 0.1


def test_free_space_is_one_piece_and_walled(site):
    free, unknown = np.asarray(site.free), np.asarray(site.unknown)
    assert ndimage.label(free)[1] == 1
    labels, _ = ndimage.label(unknown)
    outside = labels == labels[0, 0]
    assert outside[0].all()
    assert outside[:, -1].all()
    assert not (ndimage.binary_dilation(outside, np.ones((3, 3))) & free).any()


def test_buildings_can_be_entered(site):
    """Streets alone would be a third of the site: the rest of what is free is indoors."""
    thick = ndimage.distance_transform_edt(np.asarray(site.free)) * 0.2
    wide = ndimage.label(np.asarray(site.free) & (thick > 0.25))[0]
    assert np.bincount(wide.ravel())[1:].max() > 0.8 * (wide > 0).sum()


def test_same_seed_same_campus_and_another_is_another():
    first, again, other = (
        np.asarray(campus(seed, 3_000.0, 0.2).cells) for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).mean() > 0.1


def test_no_two_buildings_are_alike(site):
    """Ranges sorted, so blind to heading, tell places far from each other apart."""
    rows, columns = np.nonzero(np.asarray(site.distance * site.free) > 0.5)
    pick = np.random.default_rng(0).integers(len(rows), size=150)
    cells = np.stack([columns[pick], rows[pick]], axis=-1) + 0.5
    poses = jnp.pad(site.to_map(jnp.asarray(cells, float)), ((0, 0), (0, 1)))
    scans = np.sort(SEEN(site, poses, BEARINGS, 30.0))
    apart = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=-1) > 3
    differ = np.abs(scans[:, None] - scans).mean(axis=-1)
    assert differ[apart].min() > 0.05


def test_the_office_is_what_it_was():
    """Drawn by what the campus draws with; its free cells are counted here."""
    assert int(np.asarray(office(0).free).sum()) == OFFICE


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"free_area": 2_000.0}, "buildings.office"),
        ({"free_area": float("nan")}, "3000 m²"),
        ({"free_area": float("inf")}, "3000 m²"),
        ({"resolution": 0.3}, "resolution"),
        ({"free_area": 1e6}, "coarser"),
    ],
)
def test_silly_sizes(arguments, message):
    with pytest.raises(ValueError, match=message):
        campus(**arguments)
