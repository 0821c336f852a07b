"""Maps of every kind that `map_server` reads, the traps they hold, and what to say."""

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml

from fsmsm_jax.world.occupancy import OccupancyGrid
from fsmsm_jax.world.ros_map import load_map, save_map

DATA = Path(
    os.environ.get("FSMSM_DATA", Path(__file__).resolve().parents[3] / "shared/data")
)
MAPS = sorted(
    path for folder in ("maps", "gl", "real") for path in DATA.glob(f"{folder}/*.yaml")
)
ABSENT = f"no maps under {DATA}; point FSMSM_DATA at the recordings"
NONE = pytest.param(None, marks=pytest.mark.skip(reason=ABSENT))
META = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [1.0, -2.0, 0.5],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


# ---- images, written byte by byte -----------------------------------------------------


def pgm(pixels, top=255, plain=False):
    pixels = np.asarray(pixels)
    kind = {(2, True): "P2", (2, False): "P5", (3, True): "P3", (3, False): "P6"}
    head = f"{kind[pixels.ndim, plain]}\n# a comment\n{pixels.shape[1]} {pixels.shape[0]}\n{top}\n"
    if plain:
        return (head + " ".join(map(str, pixels.ravel()))).encode()
    return head.encode() + pixels.astype(">u2" if top > 255 else "u1").tobytes()


def png(pixels, colour, depth=8, palette=None, transparency=None):
    """PNG by hand: colour 0 grey, 2 RGB, 3 palette, 4 grey + alpha, 6 RGBA."""

    def chunk(name, body):
        return (
            struct.pack(">I", len(body))
            + name
            + body
            + struct.pack(">I", zlib.crc32(name + body))
        )

    pixels = np.asarray(pixels).astype(">u2" if depth == 16 else "u1")
    head = struct.pack(
        ">IIBBBBB", pixels.shape[1], pixels.shape[0], depth, colour, 0, 0, 0
    )
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    extra = chunk(b"PLTE", bytes(np.ravel(palette).tolist())) if palette else b""
    extra += chunk(b"tRNS", bytes(transparency)) if transparency else b""
    end = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + end


@pytest.fixture
def write(tmp_path):
    """Write an image and its YAML; returns the YAML's path."""

    def write(image, name="map.pgm", /, **meta):
        (tmp_path / name).write_bytes(image)
        meta = {
            key: v for key, v in (META | {"image": name} | meta).items() if v is not ...
        }
        (tmp_path / "map.yaml").write_text(yaml.safe_dump(meta))
        return tmp_path / "map.yaml"

    return write


def cells_of(path):
    return np.asarray(load_map(path).cells).tolist()


GREYS = np.array([[0, 205, 254], [255, 89, 90]])
TRINARY = [
    [0, 100, -1],
    [100, -1, 0],
]  # bottom row first; 89 is 0.651 occupied, 90 is 0.647


# ---- formats --------------------------------------------------------------------------


def test_origin_resolution_and_row_order(write):
    grid = load_map(write(pgm(GREYS)))
    np.testing.assert_array_equal(grid.origin, np.float32([1.0, -2.0, 0.5]))
    assert grid.resolution == np.float32(0.05)
    assert np.asarray(grid.cells).tolist() == TRINARY


RGB = np.repeat(GREYS[..., None], 3, axis=-1)
SPREAD = RGB + np.array([-1, 0, 1]) * (RGB > 0) * (RGB < 255)  # same mean, coloured
OPAQUE = np.full((2, 3, 1), 255)


@pytest.mark.parametrize(
    ("image", "name"),
    [
        (pgm(GREYS), "map.pgm"),
        (pgm(GREYS, plain=True), "map.pgm"),
        (pgm(SPREAD), "map.pgm"),
        (pgm(SPREAD, plain=True), "map.pgm"),
        (pgm(GREYS * 257, top=65535), "map.pgm"),
        (pgm(GREYS * 257, top=65535, plain=True), "map.pgm"),
        (png(GREYS, 0), "map.png"),
        (png(GREYS * 257, 0, depth=16), "map.png"),
        (png(SPREAD, 2), "map.png"),
        (png(np.concatenate([SPREAD, OPAQUE], -1), 6), "map.png"),
        (png(np.concatenate([GREYS[..., None], OPAQUE], -1), 4), "map.png"),
        (
            png([[0, 1, 2], [3, 4, 5]], 3, palette=SPREAD.reshape(-1, 3).tolist()),
            "map.png",
        ),
    ],
    ids=[
        *("P5", "P2", "P6", "P3", "P5-16", "P2-16", "png-grey", "png-16"),
        *("png-rgb", "png-rgba", "png-grey-alpha", "png-palette"),
    ],
)
def test_formats_agree(write, image, name):
    assert cells_of(write(image, name)) == TRINARY


def test_one_bit_images(write):
    path = write(b"P4\n3 2\n" + bytes([0b01000000, 0b00100000]))  # PBM: 1 is black
    assert cells_of(path) == [[0, 0, 100], [0, 100, 0]]


def test_colour_is_the_mean_of_the_channels(write):
    # Mean 85: occupied 0.667. Luma would call the first 76 and the second 29.
    assert cells_of(write(pgm([[[255, 0, 0], [0, 0, 255], [255, 255, 255]]]))) == [
        [100, 100, 0]
    ]


def test_largest_value_other_than_255_is_white(write):
    assert cells_of(write(pgm([[0, 100, 80, 30]], top=100))) == [[100, 0, -1, 100]]
    assert cells_of(write(pgm([[0, 15, 12]], top=15, plain=True))) == [[100, 0, -1]]


@pytest.mark.parametrize("mode", ["trinary", "scale"])
@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (png([[[0, 0], [255, 254], [255, 255], [0, 255]]], 4), [-1, -1, 0, 100]),
        (png([[[0] * 4, [255] * 3 + [9], [255] * 4]], 6), [-1, -1, 0]),
        (
            png(
                [[0, 1, 2]],
                3,
                palette=[[0] * 3, [255] * 3, [0] * 3],
                transparency=[0, 255],
            ),
            [-1, 0, 100],
        ),
        (png([[0, 7, 255]], 0, transparency=[0, 7]), [100, -1, 0]),
    ],
    ids=["grey-alpha", "rgba", "palette", "grey-key"],
)
def test_transparent_is_unknown(write, image, expected, mode):
    assert cells_of(write(image, "map.png", mode=mode)) == [expected]


def test_raw_ignores_alpha_and_negate(write):
    image = png([[[7, 0], [100, 255], [101, 255], [255, 0]]], 4)
    assert cells_of(write(image, "map.png", mode="raw", negate=1)) == [[7, 100, -1, -1]]


# ---- meaning --------------------------------------------------------------------------


@pytest.mark.parametrize("negate", [1, True])
def test_negate(write, negate):
    # 50/255 = 0.19608 is above 0.196, 49/255 below: black is now free.
    path = write(pgm([[0, 49, 50, 165, 166, 255]]), negate=negate)
    assert cells_of(path) == [[0, 0, -1, -1, 100, 100]]


def test_every_grey_against_the_rule(write):
    greys = np.arange(256)[None]
    occupancy = (255 - greys) / 255
    expected = np.where(occupancy > 0.65, 100, np.where(occupancy < 0.196, 0, -1))
    np.testing.assert_array_equal(load_map(write(pgm(greys))).cells, expected)
    assert expected[0, 205] == -1
    assert expected[0, 206] == 0


def test_a_grey_on_the_threshold_is_unknown(write):
    """51/255 is 0.2 and 153/255 is 0.6, whatever 1 − 0.8 is in floating point."""
    path = write(pgm([[204, 205, 102, 101]]), free_thresh=0.2, occupied_thresh=0.6)
    assert cells_of(path) == [[-1, 0, -1, 100]]


def test_scale(write):
    greys = np.arange(256)[None]
    path = write(pgm(greys), mode="scale", free_thresh=0.2, occupied_thresh=0.7)
    cells = np.asarray(load_map(path).cells)[0]
    percent = ((255 - greys[0]) / 255 - 0.2) / 0.5 * 100
    assert np.abs(cells - np.clip(percent, 0, 100)).max() <= 0.5 + 1e-9
    assert cells[0] == 100
    assert cells[255] == 0


def test_scale_with_extreme_thresholds(write):
    path = write(
        pgm([[0, 51, 128, 255]]), mode="scale", free_thresh=0.0, occupied_thresh=1.0
    )
    assert cells_of(path) == [[100, 80, 50, 0]]


def test_thresholds_may_meet(write):
    path = write(pgm([[0, 127, 128, 255]]), free_thresh=0.5, occupied_thresh=0.5)
    assert cells_of(path) == [[100, 100, 0, 0]]


def test_raw(write):
    path = write(pgm([[0, 1, 50, 100, 101, 205, 255]]), mode="raw")
    assert cells_of(path) == [[0, 1, 50, 100, -1, -1, -1]]


def test_paths(write, tmp_path, monkeypatch):
    path = write(pgm(GREYS))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for image in (str(tmp_path / "map.pgm"), "../map.pgm"):
        (elsewhere / "other.yaml").write_text(yaml.safe_dump(META | {"image": image}))
        assert cells_of(elsewhere / "other.yaml") == TRINARY
    monkeypatch.chdir(elsewhere)
    assert cells_of(str(path)) == TRINARY  # beside the YAML, not beside the process


def test_numbers_as_yaml_writes_them(write, tmp_path):
    write(pgm(GREYS))
    text = "image: map.pgm\nresolution: 5e-2\norigin: [1, -2.0, 5e-1]\nnegate: no\n"
    (tmp_path / "map.yaml").write_text(
        text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    grid = load_map(tmp_path / "map.yaml")
    assert grid.resolution == np.float32(0.05)
    np.testing.assert_array_equal(grid.origin, np.float32([1.0, -2.0, 0.5]))


def test_unknown_is_passed_on(write):
    image = pgm(np.pad(np.full((3, 3), 254), 2, constant_values=205))
    assert load_map(write(image)).clearance[4, 4] > 2
    assert load_map(write(image), unknown="opaque").clearance[4, 4] == 2


# ---- there and back -------------------------------------------------------------------


@pytest.mark.parametrize("values", [[-1, 0, 100], np.arange(-1, 101), [0, 100], [3]])
@pytest.mark.parametrize(
    "origin", [(0.0, 0.0, 0.0), (-12.345678, 1e-7, 3.14), (1 / 3, -5e4, -2.0)]
)
@pytest.mark.parametrize("resolution", [0.05, 1 / 3, 1.0, 1e-5])
def test_there_and_back(tmp_path, values, origin, resolution):
    cells = np.random.default_rng(0).choice(values, size=(13, 29))
    cells[0, 0] = min(v for v in values if v >= 0)
    grid = OccupancyGrid.from_cells(cells, resolution, origin)
    save_map(grid, tmp_path / "saved: #1.yaml")
    again = load_map(tmp_path / "saved: #1.yaml")
    for name in ("cells", "resolution", "origin", "clearance", "distance", "slope"):
        np.testing.assert_array_equal(
            getattr(again, name), getattr(grid, name), err_msg=name
        )


def test_saved_as_map_saver_does(tmp_path):
    grid = OccupancyGrid.from_cells(np.array([[0, 100], [-1, 0]]), 0.05, (1.5, 0, 0.25))
    save_map(grid, str(tmp_path / "m.yaml"))
    assert (tmp_path / "m.pgm").read_bytes().endswith(bytes([205, 254, 254, 0]))
    meta = yaml.safe_load((tmp_path / "m.yaml").read_text())
    assert meta == {
        **{
            "image": "m.pgm",
            "mode": "trinary",
            "resolution": 0.05,
            "origin": [1.5, 0.0, 0.25],
        },
        **{"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196},
    }


def test_save_says_what_is_wrong(tmp_path):
    grid = OccupancyGrid.from_cells(np.zeros((2, 2), int), 0.05)
    with pytest.raises(ValueError, match=r"must end in \.yaml"):
        save_map(grid, tmp_path / "map.pgm")
    with pytest.raises(ValueError, match="cannot write"):
        save_map(grid, tmp_path / "nowhere" / "map.yaml")


# ---- what is wrong, and what to do ----------------------------------------------------


@pytest.mark.parametrize("key", META)
def test_missing_key(write, key):
    with pytest.raises(ValueError, match=rf"map\.yaml lacks {key}; a map_server map"):
        load_map(write(pgm(GREYS), **{key: ...}))
    with pytest.raises(ValueError, match=rf"map\.yaml lacks {key}; a map_server map"):
        load_map(write(pgm(GREYS), **{key: None}))


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"resolution": 0}, "resolution must be more than 0"),
        ({"resolution": -0.05}, "resolution must be more than 0"),
        ({"resolution": float("nan")}, "resolution must be a finite number"),
        ({"resolution": float("inf")}, "resolution must be a finite number"),
        ({"resolution": "5 cm"}, "resolution must be a finite number, got '5 cm'"),
        ({"resolution": [0.05]}, "resolution must be a finite number"),
        ({"resolution": True}, "resolution must be a finite number"),
        ({"origin": [0.0, float("nan"), 0.0]}, "origin must be a finite number"),
        (
            {"origin": [0.0, 0.0, "north"]},
            "origin must be a finite number, got 'north'",
        ),
        ({"origin": [0.0, 0.0]}, "origin must be three numbers .* yaw of 0.0"),
        ({"origin": [0.0, 0.0, 0.0, 1.0]}, "origin must be three numbers"),
        ({"origin": 0.0}, "origin must be three numbers"),
        ({"mode": "binary"}, "mode must be one of trinary, scale, raw, got 'binary'"),
        ({"mode": ["raw"]}, "mode must be one of"),
        ({"negate": 2}, "negate must be 0 or 1"),
        ({"negate": "perhaps"}, "negate must be 0 or 1"),
        ({"free_thresh": 0.7}, "expected 0 ≤ free_thresh ≤ occupied_thresh ≤ 1"),
        ({"free_thresh": -0.1}, "expected 0 ≤ free_thresh"),
        ({"occupied_thresh": 65}, "expected 0 ≤ free_thresh"),
        ({"occupied_thresh": "high"}, "occupied_thresh must be a finite number"),
        ({"free_thresh": float("nan")}, "free_thresh must be a finite number"),
        ({"image": 3}, "image must be the path of a picture, got 3"),
        ({"image": ""}, "image must be the path of a picture"),
        ({"image": "lost.pgm"}, r"names the image .*lost\.pgm, which is not there"),
        ({"image": "."}, "which is not there"),
    ],
)
def test_bad_entry(write, meta, message):
    path = write(pgm(GREYS))
    path.write_text(yaml.safe_dump(META | meta))
    with pytest.raises(ValueError, match=rf"map\.yaml.*{message}"):
        load_map(path)


@pytest.mark.parametrize("plain", [True, False])
def test_truncated_pgm(write, plain):
    image = pgm(np.full((40, 50), 254), plain=plain)
    for cut in (len(image) // 2, 20, 3, 0):
        with pytest.raises(
            ValueError, match=r"cannot read the image .*map\.pgm.*export it again"
        ):
            load_map(write(image[:cut]))


@pytest.mark.parametrize(
    "image", [pgm(np.full((40, 50, 3), 254)), pgm(np.ones((40, 50)), 65535)]
)
def test_truncated_colour_and_deep_pgm(write, image):
    with pytest.raises(ValueError, match="cannot read the image"):
        load_map(write(image[:-7]))


def test_truncated_png(write):
    image = png(np.random.default_rng(0).integers(0, 255, (40, 50)), 0)
    for cut in (len(image) * 2 // 3, 40, 5):
        with pytest.raises(ValueError, match=r"cannot read the image .*map\.png"):
            load_map(write(image[:cut], "map.png"))


def test_not_an_image(write):
    with pytest.raises(ValueError, match="must be a whole PGM, PNG, BMP"):
        load_map(write(b"Location: https://example.com/map.pgm\n"))


def test_no_free_cell(write):
    with pytest.raises(
        ValueError, match=r"no cell of the map is free \(50% unknown.*negate"
    ):
        load_map(write(pgm([[0, 205]])))


def test_unreadable_yaml(write, tmp_path):
    with pytest.raises(ValueError, match=r"cannot read the map file .*nowhere\.yaml"):
        load_map(tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="cannot read the map file"):
        load_map(tmp_path)
    path = write(pgm(GREYS))
    with pytest.raises(ValueError, match="not the image itself"):
        load_map(tmp_path / "map.pgm")
    path.write_text("image: [map.pgm\nresolution: 0.05")
    with pytest.raises(ValueError, match="not a YAML file"):
        load_map(path)
    for text in ("", "just words", "- a\n- list\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match="key: value"):
            load_map(path)


# ---- maps of others -------------------------------------------------------------------


def read_slowly(path):
    """Grey levels (mean of channels) of a P2, P5 or P6 file, straight from its bytes."""
    data, tokens, at = path.read_bytes(), [], 0
    while len(tokens) < 4:
        end = data.index(b"\n", at)
        line, at = data[at:end].split(b"#")[0], end + 1
        tokens += line.split()
    kind, (width, height, top) = tokens[0], map(int, tokens[1:])
    assert top == 255
    channels = 3 if kind == b"P6" else 1
    if kind == b"P2":
        values = np.array(data[at:].split(), int)
    else:
        values = np.frombuffer(data, np.uint8, width * height * channels, at)
    return values.reshape(height, width, channels).mean(axis=-1)


@pytest.mark.parametrize("path", MAPS or [NONE], ids=lambda path: path and path.stem)
def test_data_maps(path):
    meta = yaml.safe_load(path.read_text())
    grid = load_map(path)
    assert grid.resolution == np.float32(meta["resolution"])
    np.testing.assert_array_equal(grid.origin, np.float32(meta["origin"]))
    assert 0 < grid.free.mean() < 1
    image = path.parent / meta["image"]
    if image.suffix != ".pgm":
        return
    occupancy = (255 - read_slowly(image)) / 255
    free, occupied = meta["free_thresh"], meta["occupied_thresh"]
    between = -1
    if meta.get("mode") == "scale":
        between = np.rint((occupancy - free) / (occupied - free) * 100)
    expected = np.where(
        occupancy > occupied, 100, np.where(occupancy < free, 0, between)
    )
    np.testing.assert_array_equal(grid.cells, expected[::-1])


FACTS = {
    # name: (height, width), origin, how many cells are free, occupied, unknown
    "f1tenth_sim__stata_basement": ((1300, 1730), [25.9, 48.5, 3.14], None),
    "nav2__testmap": ((10, 10), [2.0, 3.0, 1.0], (71, 29, 0)),
    "mir_robot__maze": ((400, 400), [0, 0, 0], (150968, 6064, 2968)),
    "fetch_maps__9_16_15": ((968, 1181), [0, 0, 0], (305642 + 9254, 26050, 802262)),
    "f1tenth_sim__berlin": (
        (600, 600),
        [-11.60654, -26.520793, 0],
        (107954, 252046, 0),
    ),
    "nav2__TenByTen": ((10, 10), [0, 0, 0], (78, 6 + 12 + 2, 2)),
    "husky__playpen_map": ((1984, 1984), [-50, -50, 0], None),
    "nav2__depot_speed": (
        (307, 604),
        [0, 0, 0],
        (123746 + 25017 + 4228, 28702 + 3735, 0),
    ),
}


@pytest.mark.parametrize("name", FACTS)
def test_data_facts(name):
    path = DATA / "maps" / f"{name}.yaml"
    if not path.exists():
        pytest.skip(ABSENT)
    shape, origin, counts = FACTS[name]
    grid = load_map(path)
    assert grid.cells.shape == shape
    np.testing.assert_array_equal(grid.origin, np.float32(origin))
    if counts:
        assert (grid.free.sum(), grid.occupied.sum(), grid.unknown.sum()) == counts


@pytest.mark.skipif(not MAPS, reason=ABSENT)
def test_data_maps_there_and_back(tmp_path):
    for name in ("nav2__depot_speed", "nav2__testmap", "f1tenth_sim__columbia"):
        grid = load_map(DATA / "maps" / f"{name}.yaml")
        save_map(grid, tmp_path / "again.yaml")
        again = load_map(tmp_path / "again.yaml")
        np.testing.assert_array_equal(again.cells, grid.cells)
        np.testing.assert_array_equal(again.origin, grid.origin)
