import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.io import TumWriter, read_tum, write_tum

STAMPS = np.array([1663967375.543606, 1663967375.75, 1663967376.0])
POSES = np.array([[1.0, -2.5, 3.0], [0.0, 0.125, -3.0], [1e-3, 0.0, 0.0]])


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "run.tum"
    write_tum(path, STAMPS, POSES)
    stamps, poses = read_tum(path)
    np.testing.assert_allclose(stamps, STAMPS, rtol=0, atol=1e-6)
    np.testing.assert_allclose(poses, POSES, atol=1e-6)
    line = path.read_text().splitlines()[1].split()
    assert line[3:6] == ["0", "0", "0"]
    assert float(line[6]) ** 2 + float(line[7]) ** 2 == pytest.approx(1)
    write_tum(path, STAMPS[:0], POSES[:0])
    assert [len(part) for part in read_tum(path)] == [0, 0]


def test_unknown_poses_are_left_out(tmp_path):
    poses = POSES.copy()
    poses[1, 2] = np.nan
    write_tum(tmp_path / "run.tum", STAMPS, poses)
    np.testing.assert_allclose(read_tum(tmp_path / "run.tum")[1], POSES[[0, 2]])


def test_each_pose_is_on_the_disk_at_once(tmp_path):
    path = tmp_path / "run.tum"
    with TumWriter(path) as out:
        out.write(1.0, POSES[0])
        np.testing.assert_array_equal(read_tum(path)[0], [1])
        out.write(jnp.float32(2.0), jnp.asarray(POSES[1]))
        np.testing.assert_array_equal(read_tum(path)[0], [1, 2])
    with pytest.raises(ValueError, match="closed"):
        out.write(3.0, POSES[2])


def test_what_cannot_be_written(tmp_path):
    with pytest.raises(ValueError, match=r"2 stamps need poses of shape \(2, 3\)"):
        write_tum(tmp_path / "run.tum", STAMPS[:2], POSES)
    with pytest.raises(ValueError, match="finite time, got nan"):
        write_tum(tmp_path / "run.tum", np.array([np.nan]), POSES[:1])


def test_comments_and_a_torn_last_line_are_left_out(tmp_path):
    path = tmp_path / "run.tum"
    path.write_text("# t x y z\n\n1 2 3 0 0 0 0 1\n2 3 4 0 0")
    stamps, poses = read_tum(path)
    np.testing.assert_array_equal(stamps, [1])
    np.testing.assert_array_equal(poses, [[2, 3, 0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1 is no .* 3 numbers instead of 8"),
        ("\n1 2 3 x 0 0 0 1\n", "line 2 is no .* could not convert"),
        ("1 2 3\n1 2 3 0 0 0 0 1", "line 1"),
        ("1,2,3,0,0,0,0,1\n", "line 1 is no .* could not convert"),
        (",,\n1 2 3 0 0 0 0 1\n", "line 1 is no .* could not convert"),
    ],
)
def test_what_is_no_trajectory(tmp_path, text, message):
    (tmp_path / "run.tum").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_tum(tmp_path / "run.tum")
    with pytest.raises(ValueError, match="there is no trajectory at"):
        read_tum(tmp_path / "missing.tum")
