from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fsmsm_jax.io import programs
from fsmsm_jax.io.programs import Program, platform_here, recalled

WALLS = {"x": jnp.array([3.0, -4.0, 5.5]), "count": jnp.array(3)}
POINT = jnp.array([12.5, -7.25])


class Answer(NamedTuple):
    nearest: jax.Array
    spectrum: jax.Array


def nearest(walls, point, weight):
    """A sort, an FFT and a loop, as trackers have them."""
    off = jnp.sort(jnp.abs(walls["x"] - point[0]))
    grown = jax.lax.while_loop(lambda v: v < weight, lambda v: 2 * v, off[0])
    return Answer(grown, jnp.abs(jnp.fft.fft(off * walls["count"])))


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "nearest.fsmsm"
    arguments = (POINT, jnp.array(40.0))
    Program.trace("nearest", nearest, WALLS, arguments, unit="m").save(path)
    return path


def test_a_file_computes_what_the_function_does(stored):
    program = Program.load(stored, "nearest")
    assert program.about == {"unit": "m"}
    run = program.compiled()
    for point, weight in ((POINT, 40.0), (np.array([-1.0, 2.0]), 3)):
        expected = jax.jit(nearest)(WALLS, jnp.asarray(point), weight)
        for found, leaf in zip(run(point, weight), expected, strict=True):
            np.testing.assert_allclose(found, leaf, rtol=1e-6)  # compiled once more


def test_a_file_of_single_precision_serves_a_process_of_double(stored):
    expected = Program.load(stored, "nearest").compiled()(POINT, 40.0)
    with jax.enable_x64(True):
        found = Program.load(stored, "nearest").compiled()(
            np.asarray(POINT, np.float64), 40.0
        )
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_shapes_that_it_is_not_for_are_named(stored):
    run = Program.load(stored, "nearest").compiled()
    with pytest.raises(ValueError, match=r"\(2,\), \(\), got \(3,\), \(\); export"):
        run(jnp.zeros(3), 40.0)
    with pytest.raises(ValueError, match="got"):
        run(POINT)


def test_files_that_are_of_no_use_say_why(stored, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"cannot read a tracker .*holds a nearest"):
        Program.load(stored, "tracker")
    with pytest.raises(ValueError, match="cannot read a nearest"):
        Program.load(tmp_path / "missing", "nearest")
    whole = stored.read_bytes()
    for torn in (b"", whole[: len(whole) // 2], whole[:-3], b"not a program at all"):
        stored.write_bytes(torn)
        with pytest.raises(ValueError, match="cannot read a nearest"):
            Program.load(stored, "nearest")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    stored.write_bytes(flipped)
    with pytest.raises(ValueError, match="checksum"):
        Program.load(stored, "nearest")
    stored.write_bytes(whole)
    monkeypatch.setattr(programs, "_VERSION", 2)
    with pytest.raises(ValueError, match="version 1, not 2"):
        Program.load(stored, "nearest")


def test_a_jax_that_cannot_read_it_is_named(stored, monkeypatch):
    def refuse(module):
        raise ValueError("calling convention 99")

    monkeypatch.setattr(export, "deserialize", refuse)
    with pytest.raises(ValueError, match=f"jax {jax.__version__}.*99.*anew"):
        Program.load(stored, "nearest")


def test_platforms(tmp_path):
    arguments = (POINT, jnp.array(40.0))
    trace = lambda platforms: Program.trace(
        "nearest", nearest, WALLS, arguments, platforms
    )
    trace(("tpu",)).save(tmp_path / "other")
    with pytest.raises(ValueError, match=r"is for tpu, this is .*platforms="):
        Program.load(tmp_path / "other", "nearest")
    trace(("tpu", platform_here())).save(tmp_path / "both")
    assert len(Program.load(tmp_path / "both", "nearest").compiled()(POINT, 40.0)) == 2


def test_a_folder_that_is_not_there(tmp_path):
    program = Program.trace("nearest", nearest, WALLS, (POINT, jnp.array(1.0)))
    with pytest.raises(ValueError, match="cannot write"):
        program.save(tmp_path / "no" / "file")


DEFAULT = 0.5


class Size(eqx.Module):
    scale: jax.Array
    offset: float = eqx.field(static=True, default=DEFAULT)
    turns: int = eqx.field(static=True, default=2)


traced = []


@jax.jit
def grown(values, size):
    traced.append(size.turns)
    return {"sum": jnp.sum(values) * size.scale**size.turns + size.offset}


def recall(folder, length=4, turns=2, offset=DEFAULT):
    values, size = jnp.arange(float(length)), Size(jnp.array(3.0), offset, turns)
    found = recalled(folder, grown, (values, size), {"sum": 0})()
    expected = np.sum(np.arange(length)) * 3.0**turns + offset
    np.testing.assert_allclose(found["sum"], expected, rtol=1e-6)


def test_traced_once_for_each_thing_that_matters(tmp_path, monkeypatch):
    traced.clear()
    folder = tmp_path / "traces"
    for _ in range(2):  # the second time all is there
        recall(folder)
        recall(folder, length=5)
        recall(folder, turns=3)
        recall(folder, offset=float("0.5"))  # the default, from a file for instance
        jax.clear_caches()
    assert traced == [2, 2, 3]
    assert len(list(folder.iterdir())) == 3
    monkeypatch.setattr(programs, "_sources", lambda: "edited")
    recall(folder)
    monkeypatch.setenv("JAX_NUMPY_DTYPE_PROMOTION", "strict")
    jax.clear_caches()
    recall(folder)
    assert traced == [2, 2, 3, 2, 2]


def test_a_damaged_trace_is_made_anew(tmp_path):
    recall(tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:99])
    recall(tmp_path)
    assert len(path.read_bytes()) == len(whole)


def test_without_a_folder_it_works_and_keeps_nothing(tmp_path):
    (tmp_path / "file").write_text("in the way")
    recall(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "in the way"
