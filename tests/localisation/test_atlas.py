"""Building, keeping and refusing atlases."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation import (
    AtlasConfig,
    ScanAtlas,
    atlas_build as building,
    build_atlas,
    memory_estimate,
)
from fsmsm_jax.world import OccupancyGrid
from tests.oracles.localisation import shell_counts
from tests.oracles.raycast import cast_grid, cast_walls
from tests.worlds import l_room, random_grid

CONFIG = AtlasConfig(spacing=0.5, rays=36, reach=2.8, margin=0.3)
FINE = AtlasConfig(spacing=0.05, rays=36, reach=1.5)
BEARINGS = -np.pi + 2 * np.pi * np.arange(36) / 36
SHELL = 0.5
"""Width of a shell [m]; a place counts its own and both beside it."""


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


@pytest.fixture(scope="module")
def cap():
    """Half the bytes that `FINE` needs."""
    return 0.5 * memory_estimate(l_room(), FINE)


@pytest.fixture(scope="module")
def refusal(cap):
    """What is said, before anything is cast."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "_shells_from", None)
        patch.setattr(building, "likelihood_spectra", None)
        with pytest.raises(ValueError, match="a spacing of .* would fit") as refused:
            build_atlas(l_room(), FINE, max_memory=cap)
    return str(refused.value)


@pytest.fixture(scope="module")
def fitting(refusal, cap):
    """Of the spacing that was named."""
    config = dataclasses.replace(FINE, spacing=named(refusal))
    return build_atlas(l_room(), config, max_memory=cap)


def places(atlas):
    """Map-frame positions (n, 2) of all nodes, and their shells (n, bins)."""
    tiles = jax.tree.map(np.asarray, atlas.tiles)
    tile, row, column = np.nonzero(tiles.allowed)
    row, column = tiles.corner[tile].T + [row, column]
    at = atlas.lattice.to_map(jnp.asarray(row), jnp.asarray(column))
    return np.asarray(at, float), tiles.shells[tiles.allowed].astype(int)


def counts(ranges, bins):
    """Rays in each shell and both beside it."""
    one = shell_counts(ranges, np.ones(len(ranges), bool), SHELL, bins + 1)
    return np.array([one[max(b - 1, 0) : b + 2].sum() for b in range(bins)])


def named(refusal):
    """The spacing that would fit [m]."""
    return float(refusal.split("a spacing of ")[1].split(" m")[0])


def same(one, other):
    """Whether two atlases are the same, map and all."""
    assert jax.tree.structure(one) == jax.tree.structure(other)  # config, spacing
    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if ours.dtype != theirs.dtype or not np.array_equal(ours, theirs):
            return False
    return True


def test_shells_are_those_of_scans_from_each_place(grid, atlas):
    """By the oracle's casts, on a turned grid, to beyond the reach."""
    at, told = places(atlas)
    assert told.shape == (len(at), 6)
    stops, origin = np.asarray(grid.occupied), np.asarray(grid.origin, float)
    wrong = 0
    for place, found in zip(at, told, strict=True):
        poses = np.tile([*place, 0.0], (CONFIG.rays, 1))
        exact = cast_grid(stops, 0.05, origin, poses, BEARINGS, 50.0)
        wrong += np.abs(found - counts(exact, 6)).sum()
    # A ray along the edges of cells may fall to either side, out of three shells and
    # into three others.
    assert wrong < 0.01 * 6 * len(at) * CONFIG.rays


def test_where_none_may_stand_nothing_is_seen(atlas, polygon_atlas):
    for built in (atlas, polygon_atlas):
        allowed = np.asarray(built.tiles.allowed)
        assert not np.asarray(built.tiles.shells)[~allowed].any()
        assert np.asarray(built.tiles.shells)[allowed].any(axis=-1).mean() > 0.9


def test_more_places_than_a_chunk_are_all_scanned(fitting):
    """The first tile's second chunk is followed by one that is padded and cut."""
    first = int(fitting.tiles.allowed[0].sum())
    chunk = building._CHUNK
    assert first > chunk
    assert first % chunk
    at, told = places(fitting)
    start, end = np.asarray(l_room().start, float), np.asarray(l_room().end, float)
    last = len(at) - 1
    for i in {*range(0, last, 97), chunk - 1, chunk, first - 1, min(first, last), last}:
        exact = cast_walls(start, end, at[i], BEARINGS, 50.0)
        near = np.abs(exact / SHELL - np.rint(exact / SHELL)) < 1e-4
        off = np.abs(told[i] - counts(exact, 3)).sum()
        assert off <= 2 * near.sum()  # at a limit, either side will do


def test_memory_is_told_before(grid, atlas, polygon_atlas):
    for world, built in ((grid, atlas), (l_room(), polygon_atlas)):
        assert memory_estimate(world, CONFIG) == built.nbytes
        without_map = jax.tree.leaves(built)[len(jax.tree.leaves(built.world)) :]
        rest = sum(a.nbytes for a in without_map) - built.nbytes
        assert 0 <= rest < 100  # the lattice's frame


def test_too_large_an_atlas_is_refused_with_one_that_fits(refusal, cap, fitting):
    """What is named fits and is not wastefully coarse."""
    assert "spacing 0.05 m needs" in refusal
    assert fitting.nbytes <= cap
    assert f"with {fitting.nbytes / 1e6:.1f} MB" in refusal
    # Bytes go with 1 / spacing², but tiles come in rounded numbers.
    assert 0.05 * np.sqrt(2) <= fitting.config.spacing < 1.5 * 0.05 * np.sqrt(2)


def test_a_fine_spacing_that_is_a_little_too_fine():
    """Named in hundredths of a metre, it must not be rounded to what it was."""
    cap = 0.99 * memory_estimate(l_room(), FINE)
    with pytest.raises(ValueError, match="would fit, with") as refused:
        build_atlas(l_room(), FINE, max_memory=cap)
    assert 0.05 < named(str(refused.value)) < 0.08


def test_what_just_fits_is_built(monkeypatch, polygon_atlas):
    monkeypatch.setattr(building, "_TRIES", 1)  # to say what else would fit
    again = build_atlas(l_room(), CONFIG, max_memory=polygon_atlas.nbytes)
    assert same(again, polygon_atlas)
    with pytest.raises(ValueError, match="spacing"):
        build_atlas(l_room(), CONFIG, max_memory=polygon_atlas.nbytes - 1)


@pytest.mark.parametrize("cap", [0, 1000])
def test_where_nothing_fits_it_is_said(cap):
    with pytest.raises(ValueError, match="no spacing would fit"):
        build_atlas(l_room(), CONFIG, max_memory=cap)


@pytest.mark.parametrize("kind", ["grid", "polygon"])
def test_a_saved_atlas_comes_back_as_it_was(tmp_path, kind, grid, atlas, polygon_atlas):
    built, world = (atlas, grid) if kind == "grid" else (polygon_atlas, l_room())
    path = tmp_path / "folder.with.dots" / "a place"
    path.parent.mkdir()
    built.save(path)
    assert same(ScanAtlas.load(path, world), built)
    assert path.stat().st_size < built.nbytes + 5000
    assert [*path.parent.iterdir()] == [path]


@pytest.mark.parametrize("kind", ["grid", "polygon"])
def test_an_atlas_made_on_disk_is_the_one_made_in_memory(
    tmp_path, kind, grid, atlas, polygon_atlas
):
    built, world = (atlas, grid) if kind == "grid" else (polygon_atlas, l_room())
    path = tmp_path / "made.npz"
    path.write_text("what was there before")
    assert same(build_atlas(world, CONFIG, file=str(path)), built)
    built.save(tmp_path / "saved.npz")
    assert same(
        ScanAtlas.load(path, world), ScanAtlas.load(tmp_path / "saved.npz", world)
    )
    assert {p.name for p in tmp_path.iterdir()} == {"made.npz", "saved.npz"}


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt])
def test_what_breaks_off_leaves_no_file(tmp_path, monkeypatch, error, polygon_atlas):
    """In the second tile; and what was there before stays."""
    path = tmp_path / "atlas.npz"
    cast, seen = building._shells_of, []

    def broken(*of_tile):
        seen.append(of_tile)
        if len(seen) == 2:
            raise error
        return cast(*of_tile)

    monkeypatch.setattr(building, "_shells_of", broken)
    with pytest.raises(error):
        build_atlas(l_room(), CONFIG, file=path)
    assert not [*tmp_path.iterdir()]
    polygon_atlas.save(path)
    seen.clear()
    with pytest.raises(error):
        build_atlas(l_room(), CONFIG, file=path)
    assert [*tmp_path.iterdir()] == [path]
    assert same(ScanAtlas.load(path, l_room()), polygon_atlas)


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
    assert same(ScanAtlas.load(tmp_path / "atlas.npz", again), atlas)


def test_a_map_in_larger_arrays_is_the_same_map(tmp_path, grid, atlas):
    """What `padded` adds is no part of it, for building and for loading."""
    padded = grid.padded()
    assert padded.cells.shape != grid.cells.shape
    again = build_atlas(padded, CONFIG)
    assert same(again, atlas)
    for built, world in ((atlas, padded), (again, grid)):
        built.save(tmp_path / "atlas.npz")
        assert same(ScanAtlas.load(tmp_path / "atlas.npz", world), atlas)
    # But a map that truly goes on there is another one.
    more = np.asarray(padded.cells)
    assert (more == -1).sum() > (np.asarray(grid.cells) == -1).sum()
    larger = OccupancyGrid.from_cells(more, 0.05, np.asarray(grid.origin, float))
    with pytest.raises(ValueError, match="another map"):
        ScanAtlas.load(tmp_path / "atlas.npz", larger)


def spoil(path, how):
    whole = path.read_bytes()
    with np.load(path) as saved:
        arrays = dict(saved)
    rest = lambda *names: {k: a for k, a in arrays.items() if k not in names}
    if how == "missing":
        path.unlink()
    elif how == "a folder":
        path.unlink()
        path.mkdir()
    elif how.startswith("cut at "):
        path.write_bytes(whole[: int(len(whole) * float(how[7:]))])
    elif how == "last bytes gone":
        path.write_bytes(whole[:-30])
    elif how.startswith("flipped at "):
        place = int(len(whole) * float(how[11:]))
        flipped = bytes([whole[place] ^ 1])
        path.write_bytes(whole[:place] + flipped + whole[place + 1 :])
    elif how == "text":
        path.write_text("image: map.pgm\nresolution: 0.05\n")
    elif how == "other arrays":
        np.savez(path, ranges=np.ones(3))
    elif how == "one array":
        with path.open("wb") as file:
            np.save(file, np.ones(3))
    else:
        small = arrays["spectra"][:, :-1], arrays["shells"][..., :-1]
        write, kept = {
            "compressed": (np.savez_compressed, arrays),
            "no version": (np.savez, rest("version")),
            "of tomorrow": (np.savez, {**arrays, "version": np.asarray(3)}),
            "no spectra": (np.savez, rest("spectra")),
            "no spacing": (np.savez, rest("config_spacing")),
            "a negative spacing": (np.savez, {**arrays, "config_spacing": -1.0}),
            "fewer tiles": (np.savez, {**arrays, "allowed": arrays["allowed"][:-1]}),
            "fewer spectra": (np.savez, {**arrays, "spectra": arrays["spectra"][:-1]}),
            "fewer shells": (np.savez, {**arrays, "shells": small[1]}),
        }[how]
        write(path, **kept)


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("missing", "No such file"),
        ("a folder", "directory"),
        ("cut at 0", "zip"),
        ("cut at 0.01", "zip"),
        ("cut at 0.5", "zip"),
        ("cut at 0.99", "zip"),
        ("cut at 0.9999", "zip"),
        ("last bytes gone", "zip"),
        ("flipped at 0.1", "checksum"),
        ("flipped at 0.5", "checksum"),
        ("flipped at 0.9", "checksum"),
        ("text", "zip"),
        ("other arrays", "version 1, not 2"),
        ("one array", "zip"),
        ("compressed", "compressed"),
        ("no version", "version 1, not 2"),
        ("of tomorrow", "version 3, not 2"),
        ("no spectra", "spectra"),
        ("no spacing", "spacing"),
        ("a negative spacing", "spacing"),
        ("fewer tiles", "fit together"),
        ("fewer spectra", "fit together"),
        ("fewer shells", "fit together"),
    ],
)
def test_a_spoilt_file_is_refused(tmp_path, grid, atlas, how, why):
    """By its name, with the reason, and with what to do."""
    path = tmp_path / "atlas.npz"
    atlas.save(path)
    spoil(path, how)
    with pytest.raises(
        ValueError, match=f"cannot read a scan atlas from .*{why}"
    ) as no:
        ScanAtlas.load(path, grid)
    assert str(path) in str(no.value)
    assert "build_atlas" in str(no.value)


def test_a_changed_byte_of_the_directory_is_refused_or_means_nothing(
    tmp_path, grid, atlas
):
    """The last part of the file is the zip's own, without a checksum."""
    path = tmp_path / "atlas.npz"
    atlas.save(path)
    whole = path.read_bytes()
    refused = 0
    for place in range(len(whole) - 900, len(whole), 7):
        for flip in (1, 255):
            flipped = bytes([whole[place] ^ flip])
            path.write_bytes(whole[:place] + flipped + whole[place + 1 :])
            said = ""
            try:
                assert same(ScanAtlas.load(path, grid), atlas)
            except ValueError as no:
                said = str(no)
            assert not said or "cannot read a scan atlas" in said
            refused += bool(said)
    assert refused > 50


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ({"spacing": 0.0}, "spacing"),
        ({"spacing": -1.0}, "spacing"),
        ({"spacing": float("nan")}, "spacing"),
        ({"reach": float("inf")}, "reach"),
        ({"reach": 0.0}, "reach"),
        ({"softness": -0.1}, "softness"),
        ({"rays": 4}, "rays"),
        ({"rays": 256}, "rays"),
        ({"margin": -0.1}, "margin"),
        ({"margin": float("nan")}, "margin"),
    ],
)
def test_settings_that_make_no_atlas_are_refused(setting, match):
    with pytest.raises(ValueError, match=match):
        AtlasConfig(**setting)


def test_more_rays_than_a_byte_counts_are_the_limit():
    assert AtlasConfig(rays=255).rays == 255


@pytest.mark.parametrize("value", [100, -1])
def test_a_map_without_free_space_is_refused(value):
    world = OccupancyGrid.from_cells(np.full((20, 30), value), 0.05, (3.0, 4.0, 0.5))
    with pytest.raises(ValueError, match="free|known"):
        build_atlas(world, CONFIG)
    with pytest.raises(ValueError, match="free|known"):
        memory_estimate(world, CONFIG)
    with pytest.raises(ValueError, match="spacing"):  # its node is beside the room
        build_atlas(l_room(), AtlasConfig(spacing=50.0))


def test_a_progress_bar_on_request(capsys):
    build_atlas(l_room(), CONFIG)
    assert capsys.readouterr().err == ""
    build_atlas(l_room(), CONFIG, progress=True)
    told = capsys.readouterr()
    assert "positions" in told.err
    assert "MB" in told.err
    assert told.out == ""
