"""Building, keeping and refusing atlases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from fsmsm_jax.localisation import AtlasConfig, ScanAtlas, build_atlas
from fsmsm_jax.localisation.atlas import memory_estimate, range_phases
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import OccupancyGrid, PolygonMap
from tests.oracles.raycast import cast_grid, cast_walls
from tests.worlds import l_room, random_grid

CONFIG = AtlasConfig(spacing=0.5, rays=36, range_max=10.0, reach=6.0, margin=0.3)

cast = jax.jit(raycast)


@pytest.fixture(scope="module")
def grid():
    """Turned, shifted, with an unknown patch."""
    world = random_grid(3, 70, 100)
    assert np.asarray(world.unknown).any()
    return world


@pytest.fixture(scope="module")
def atlas(grid):
    return build_atlas(grid, CONFIG)


@pytest.fixture(scope="module")
def polygon_atlas():
    return build_atlas(l_room(), CONFIG)


def positions(atlas):
    row, column = np.nonzero(np.asarray(atlas.lattice.allowed))
    return atlas.lattice.to_map(jnp.asarray(row), jnp.asarray(column))


def cells_of(grid, points):
    """(column, row) of map-frame points, by hand and in float64."""
    x, y, yaw = np.asarray(grid.origin, float)
    off = np.asarray(points, float) - [x, y]
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]])
    return np.floor(local.T / float(grid.resolution)).astype(int)


def test_positions_stand_in_or_near_free_space(grid, atlas):
    """On a turned grid: near is half a spacing, or the margin where nothing is known."""
    column, row = cells_of(grid, positions(atlas)).T
    free, unknown = np.asarray(grid.free), np.asarray(grid.unknown)
    height, width = free.shape
    assert ((column >= 0) & (column < width) & (row >= 0) & (row < height)).all()
    gap = cKDTree(np.argwhere(free)).query(np.stack([row, column], axis=1))[0] * 0.05
    reach = np.where(unknown[row, column], max(CONFIG.margin, 0.25), 0.25)
    assert (gap <= reach + 1e-6).all()
    assert (gap == 0).mean() > 0.5  # most stand on a free cell itself


def test_no_node_on_a_free_cell_is_left_out(grid, atlas):
    allowed = np.asarray(atlas.lattice.allowed)
    row, column = (jnp.asarray(i) for i in np.indices(allowed.shape))
    nodes = atlas.lattice.to_map(row, column).reshape(-1, 2)
    j, i = cells_of(grid, nodes).T
    height, width = grid.cells.shape
    on_map = (j >= 0) & (j < width) & (i >= 0) & (i < height)
    i, j = np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)
    on_free = (on_map & np.asarray(grid.free)[i, j]).reshape(allowed.shape)
    assert on_free.any()
    assert allowed[on_free].all()
    # And the lattice leaves no known cell farther away than half its diagonal.
    known = np.argwhere(np.asarray(grid.free | grid.occupied)) + 0.5
    x, y = np.asarray(grid.to_map(jnp.asarray(known[:, ::-1], float))).T
    gap = cKDTree(np.asarray(nodes)).query(np.stack([x, y], axis=1))[0]
    assert gap.max() < CONFIG.spacing / np.sqrt(2) + 0.05


def test_nodes_are_one_spacing_apart_and_turned_with_the_map(grid, atlas):
    at = lambda r, c: np.asarray(atlas.lattice.to_map(jnp.asarray(r), jnp.asarray(c)))
    yaw = float(grid.origin[2])
    along = CONFIG.spacing * np.array([np.cos(yaw), np.sin(yaw)])
    up = CONFIG.spacing * np.array([-np.sin(yaw), np.cos(yaw)])
    np.testing.assert_allclose(at(3, 5) - at(3, 4), along, atol=1e-5)
    np.testing.assert_allclose(at(4, 4) - at(3, 4), up, atol=1e-5)


def test_polygon_positions_lie_inside(polygon_atlas):
    """The L-room is 22 m² large: 88 nodes of a half-metre lattice fall inside."""
    world = l_room()
    inside = np.asarray(positions(polygon_atlas), float)
    start, end = np.asarray(world.start, float), np.asarray(world.end, float)
    angles = 2 * np.pi * np.arange(3) / 3 + 0.1
    for place in inside:  # whoever is inside meets walls all around, and near
        assert cast_walls(start, end, place, angles, 50.0).max() < 10
    assert len(inside) == len(polygon_atlas.panoramas)
    area = 6 * 2.5 + 3 * 3.5
    assert abs(len(inside) - area / CONFIG.spacing**2) <= 12  # half a node an edge


def test_panoramas_are_scans_in_the_map_frame(grid, atlas):
    """Ray n looks along −π + 2πn/rays of the map, whatever the grid's yaw."""
    bearings = -np.pi + 2 * np.pi * np.arange(CONFIG.rays) / CONFIG.rays
    places = np.asarray(positions(atlas), float)
    wrong = 0
    for place, spectrum in zip(places, np.asarray(atlas.panoramas), strict=True):
        poses = np.tile([*place, 0.0], (CONFIG.rays, 1))
        stops, origin = np.asarray(grid.occupied), np.asarray(grid.origin, float)
        exact = cast_grid(stops, 0.05, origin, poses, bearings, CONFIG.range_max)
        wanted = np.asarray(range_phases(jnp.asarray(exact, float)))
        wrong += np.sum(np.abs(np.fft.ifft(spectrum) - wanted) > 0.01)
    # Rays along the edges of cells may fall to either side.
    assert wrong < 0.02 * places.shape[0] * CONFIG.rays


def test_row_of_counts_the_positions(atlas):
    allowed = np.asarray(atlas.lattice.allowed)
    rows = np.asarray(atlas.row_of)
    np.testing.assert_array_equal(rows[allowed], np.arange(len(atlas.panoramas)))


def test_more_positions_than_a_chunk_are_all_scanned():
    """1 452 positions: the second chunk is padded and cut."""
    room = PolygonMap.from_outlines([[5, -4], [16, -4], [16, -1], [5, -1]])
    config = AtlasConfig(spacing=0.15, rays=8, range_max=20.0)
    atlas = build_atlas(room, config)
    assert len(atlas.panoramas) > 1024
    place = positions(atlas)
    assert len(place) == len(atlas.panoramas)
    bearings = -np.pi + 2 * np.pi * np.arange(8) / 8
    for i in (0, 1023, 1024, len(place) - 1):
        ranges = cast(room, jnp.append(place[i], 0.0), jnp.asarray(bearings, float))
        kept = np.fft.ifft(atlas.panoramas[i])
        np.testing.assert_allclose(
            kept, range_phases(jnp.minimum(ranges, 20.0)), atol=1e-3
        )


def test_memory_is_told_before(grid, atlas, polygon_atlas):
    for world, built in ((grid, atlas), (l_room(), polygon_atlas)):
        spectra = built.panoramas.nbytes + built.end_points.nbytes
        assert memory_estimate(world, CONFIG) == spectra
        without_map = jax.tree.leaves(built)[len(jax.tree.leaves(world)) :]
        rest = sum(a.nbytes for a in without_map) - spectra
        assert 0 <= rest < 0.1 * spectra  # the lattice's own book-keeping


@pytest.mark.parametrize("kind", ["grid", "polygon"])
def test_a_saved_atlas_comes_back_as_it_was(tmp_path, kind, grid, atlas, polygon_atlas):
    built, world = (atlas, grid) if kind == "grid" else (polygon_atlas, l_room())
    path = tmp_path / "folder.with.dots" / "a place"
    path.parent.mkdir()
    built.save(path)
    loaded = ScanAtlas.load(path, world)
    assert jax.tree.structure(loaded) == jax.tree.structure(built)  # config, spacing
    for ours, theirs in zip(
        jax.tree.leaves(loaded), jax.tree.leaves(built), strict=True
    ):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    assert path.stat().st_size < 1.1 * memory_estimate(world, CONFIG) + 5000


def changed(world, kind):
    cells = np.array(world.cells)
    origin, unknown = np.asarray(world.origin, float), "transparent"
    if kind == "one cell":
        row, column = np.argwhere(cells == 0)[0]
        cells[row, column] = 100
    elif kind == "shifted":
        origin = origin + [0.5, 0.0, 0.0]
    elif kind == "turned":
        origin = origin + [0.0, 0.0, 0.1]
    elif kind == "resolution":
        return OccupancyGrid.from_cells(cells, 0.06, origin)
    elif kind == "unknown":
        unknown = "opaque"
    return OccupancyGrid.from_cells(cells, 0.05, origin, unknown=unknown)


@pytest.mark.parametrize(
    "kind", ["one cell", "shifted", "turned", "resolution", "unknown", "polygon"]
)
def test_an_atlas_of_another_map_is_refused(tmp_path, grid, atlas, kind):
    atlas.save(tmp_path / "atlas.npz")
    world = l_room() if kind == "polygon" else changed(grid, kind)
    with pytest.raises(ValueError, match="another map"):
        ScanAtlas.load(tmp_path / "atlas.npz", world)


def test_the_same_map_built_again_is_accepted(tmp_path, grid, atlas):
    atlas.save(tmp_path / "atlas.npz")
    again = changed(grid, "nothing")
    loaded = ScanAtlas.load(tmp_path / "atlas.npz", again)
    assert loaded.world is again


def spoil(path, how):
    whole = path.read_bytes()
    if how == "missing":
        path.unlink()
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "half":
        path.write_bytes(whole[: len(whole) // 2])
    elif how == "last bytes gone":
        path.write_bytes(whole[:-30])
    elif how == "a flipped byte":
        middle = len(whole) // 2
        flipped = bytes([whole[middle] ^ 255])
        path.write_bytes(whole[:middle] + flipped + whole[middle + 1 :])
    elif how == "text":
        path.write_text("image: map.pgm\nresolution: 0.05\n")
    elif how == "other arrays":
        np.savez(path, ranges=np.ones(3))
    elif how == "one array":
        with path.open("wb") as file:
            np.save(file, np.ones(3))
    elif how == "a folder":
        path.unlink()
        path.mkdir()
    elif how in ("too few panoramas", "other ray count"):
        with np.load(path) as saved:
            arrays = dict(saved)
        kept = arrays["panoramas"]
        fewer = kept[:-1] if how == "too few panoramas" else kept[:, :-1]
        np.savez(path, **{**arrays, "panoramas": fewer})


@pytest.mark.parametrize(
    "how",
    [
        "missing",
        "empty",
        "half",
        "last bytes gone",
        "a flipped byte",
        "text",
        "other arrays",
        "one array",
        "a folder",
        "too few panoramas",
        "other ray count",
    ],
)
def test_a_spoilt_file_is_refused(tmp_path, grid, atlas, how):
    path = tmp_path / "atlas.npz"
    atlas.save(path)
    spoil(path, how)
    with pytest.raises(ValueError, match="atlas"):
        ScanAtlas.load(path, grid)


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ({"spacing": 0.0}, "spacing"),
        ({"spacing": -1.0}, "spacing"),
        ({"spacing": float("nan")}, "spacing"),
        ({"range_max": float("inf")}, "range_max"),
        ({"reach": 0.0}, "reach"),
        ({"softness": -0.1}, "softness"),
        ({"rays": 4}, "rays"),
        ({"margin": -0.1}, "margin"),
        ({"margin": float("nan")}, "margin"),
    ],
)
def test_settings_that_make_no_atlas_are_refused(setting, match):
    with pytest.raises(ValueError, match=match):
        AtlasConfig(**setting)


@pytest.mark.parametrize("value", [100, -1])
def test_a_map_without_free_space_is_refused(value):
    world = OccupancyGrid.from_cells(np.full((20, 30), value), 0.05, (3.0, 4.0, 0.5))
    with pytest.raises(ValueError, match="free|known"):
        build_atlas(world, CONFIG)
    with pytest.raises(ValueError, match="free|known"):
        memory_estimate(world, CONFIG)


@pytest.mark.parametrize("kind", ["grid", "polygon"])
def test_too_coarse_a_lattice_is_refused(kind, grid):
    """Its one node would stand 25 m beside the map, where nothing is known."""
    world = grid if kind == "grid" else l_room()
    with pytest.raises(ValueError, match="spacing"):
        build_atlas(world, AtlasConfig(spacing=50.0, rays=36))


def test_a_progress_bar_on_request(capsys):
    config = AtlasConfig(spacing=0.5, rays=36, range_max=10.0, reach=6.0, margin=0.3)
    build_atlas(l_room(), config)
    assert capsys.readouterr().err == ""
    build_atlas(l_room(), config, progress=True)
    told = capsys.readouterr()
    assert "positions" in told.err
    assert "MB" in told.err
    assert told.out == ""
