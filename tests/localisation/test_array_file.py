"""Arrays on disk: whole or refused, and never half there."""

import io
import zipfile

import numpy as np
import pytest

from fsmsm_jax.localisation.array_file import UNREADABLE, read_arrays, write_arrays

BYTES = np.dtype(np.uint8)


def arrays():
    """Of all sorts: a number, a word, complex ones, columns first, of no length."""
    rng = np.random.default_rng(0)
    return {
        "version": np.asarray(2),
        "word": np.asarray("σ of the field"),
        "spectra": (rng.normal(size=(3, 5, 4)) + 1j).astype(np.complex64),
        "mask": rng.random((7, 3)) < 0.5,
        "columns": np.asfortranarray(rng.normal(size=(4, 6))),
        "slice": rng.normal(size=(6, 8))[::2, 1::3],
        "nothing": np.zeros((0, 3), np.int32),
    }


def last():
    return np.random.default_rng(1).integers(0, 255, (10, 4, 3)).astype(np.uint8)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a name.npz"
    write_arrays(path, arrays(), "last", last().shape, BYTES, np.split(last(), [1, 4]))
    return path


def test_arrays_come_back_and_numpy_reads_them_too(path):
    kept = read_arrays(path)
    with np.load(path) as by_numpy:
        assert {*kept} == {*by_numpy} == {*arrays(), "last"}
        for name, wanted in {**arrays(), "last": last()}.items():
            for found in (kept[name], by_numpy[name]):
                assert found.dtype == wanted.dtype
                np.testing.assert_array_equal(found, wanted)


def test_arrays_are_mapped_and_not_copied(path):
    base = read_arrays(path)["last"]
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(getattr(base, "obj", base), np.memmap)


def test_no_unfinished_file_is_left(path):
    assert [found.name for found in path.parent.iterdir()] == [path.name]


def broken(after, error):
    yield last()[:after]
    raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("there", [False, True])
def test_what_breaks_off_leaves_what_was_there(path, error, there):
    before = path.read_bytes()
    if not there:
        path.unlink()
    with pytest.raises(error):
        write_arrays(path, {}, "last", (10, 4, 3), BYTES, broken(4, error))
    assert [*path.parent.iterdir()] == ([path] if there else [])
    if there:
        assert path.read_bytes() == before


@pytest.mark.parametrize("rows", [9, 11])
def test_pieces_of_another_shape_are_refused(tmp_path, rows):
    path = tmp_path / "atlas.npz"
    pieces = [np.zeros((rows, 4, 3), np.uint8)]
    with pytest.raises(ValueError, match=f"10 rows of last, got {rows}"):
        write_arrays(path, {}, "last", (10, 4, 3), BYTES, pieces)
    assert not [*tmp_path.iterdir()]


def test_a_changed_byte_is_noticed_or_means_nothing(path):
    """Each third byte of the file: another year of writing is no other array."""
    whole = path.read_bytes()
    refused = 0
    for place in range(0, len(whole), 3):
        flipped = bytes([whole[place] ^ 255])
        path.write_bytes(whole[:place] + flipped + whole[place + 1 :])
        try:
            kept = read_arrays(path)
        except UNREADABLE:
            refused += 1
            continue
        for name, wanted in {**arrays(), "last": last()}.items():
            # A name that changed is missed by whoever asks for it.
            np.testing.assert_array_equal(kept.get(name, wanted), wanted)
    assert refused > 0.2 * len(whole)


def test_every_shorter_file_is_refused(path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(UNREADABLE):
            read_arrays(path)


def test_what_is_none_of_ours_is_refused(tmp_path):
    path = tmp_path / "atlas.npz"
    with pytest.raises(UNREADABLE):
        read_arrays(path)
    path.write_text("image: map.pgm\n")
    with pytest.raises(UNREADABLE):
        read_arrays(path)
    np.savez_compressed(path, last=last())
    with pytest.raises(ValueError, match="compressed"):
        read_arrays(path)
    objects = io.BytesIO()
    np.save(objects, np.array([{}], object))
    for content in (b"no array", b"", objects.getvalue()):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("last.npy", content)
        with pytest.raises(UNREADABLE):
            read_arrays(path)
