import numpy as np
import pytest

from fsmsm_jax.io import ScanLog, read_scans


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_npz_of_many_scans(tmp_path):
    ranges = np.array([[1.0, 2.0, np.inf], [0.5, np.nan, 9.0]])
    log = read_scans(
        save(
            tmp_path / "log.npz",
            ranges=ranges,
            angle_min=-1.0,
            angle_increment=1.0,
            range_min=0.1,
            range_max=8.0,
            stamp=[10.0, 11.0],
        )
    )
    assert isinstance(log, ScanLog)
    assert len(log) == 2
    np.testing.assert_array_equal(log.ranges, ranges)
    np.testing.assert_array_equal(log.bearings, [[-1, 0, 1], [-1, 0, 1]])
    np.testing.assert_array_equal(log.stamps, [10, 11])
    assert (log.range_min, log.range_max) == (0.1, 8.0)
    scan = log.scan(1)
    np.testing.assert_array_equal(scan.ranges, [0.5, 8, 8])
    np.testing.assert_array_equal(scan.valid, [True, False, True])
    np.testing.assert_array_equal(scan.echo, [True, False, False])
    np.testing.assert_array_equal(log.scan(-1).ranges, scan.ranges)


def test_npz_of_one_scan_has_the_limits_of_scan_and_no_stamps(tmp_path):
    path = save(tmp_path / "log.npz", ranges=[1, 2, 3], bearings=[0.0, 0.1, 0.3])
    log = read_scans(path)
    assert (len(log), log.range_min, log.range_max, log.stamps) == (1, 0.0, 30.0, None)
    np.testing.assert_allclose(log.scan(0).bearings, [0, 0.1, 0.3], atol=1e-6)


@pytest.mark.parametrize("key", ["range_no_return", "no_return_above"])
def test_npz_no_return_keys_are_the_largest_range(tmp_path, key):
    path = save(
        tmp_path / "log.npz",
        ranges=[1.0, 81.9],
        angle_min=0.0,
        angle_increment=1.0,
        **{key: 80.0},
    )
    log = read_scans(path)
    assert log.range_max == 80.0
    np.testing.assert_array_equal(log.scan(0).echo, [True, False])


def test_npz_rays_without_bearing_are_padding(tmp_path):
    path = save(
        tmp_path / "log.npz",
        ranges=[[1.0, 2.0], [1.0, 7.0]],
        bearings=[[0.0, 1.0], [0.0, np.nan]],
    )
    log = read_scans(path)
    np.testing.assert_array_equal(log.scan(1).valid, [True, False])
    assert np.isfinite(log.bearings).all()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"range": [1.0]}, "needs an array `ranges`, it has"),
        ({"ranges": [1.0, 2.0]}, "where its rays point"),
        ({"ranges": [1.0, 2.0], "angle_min": 0.0}, "where its rays point"),
        ({"ranges": [1.0, 2.0], "bearings": [0.0]}, "must have shape"),
        ({"ranges": np.zeros((0, 3)), "bearings": np.zeros(3)}, "non-empty"),
        ({"ranges": np.zeros((1, 2, 3)), "bearings": np.zeros(3)}, "non-empty"),
        ({"ranges": ["a", "b"], "bearings": [0.0, 1.0]}, "must hold numbers"),
        (
            {"ranges": [1.0], "angle_min": np.nan, "angle_increment": 1.0},
            "one finite number",
        ),
        (
            {"ranges": [1.0], "bearings": [1.0], "range_max": [1.0, 2.0]},
            "one finite number",
        ),
        ({"ranges": [1.0], "bearings": [1.0], "stamp": [1.0, 2.0]}, "stamps"),
    ],
)
def test_npz_that_is_no_log(tmp_path, arrays, message):
    with pytest.raises(ValueError, match=message):
        read_scans(save(tmp_path / "log.npz", **arrays))


def test_unreadable_files(tmp_path):
    with pytest.raises(ValueError, match="there is no log at"):
        read_scans(tmp_path / "missing.npz")
    whole = save(
        tmp_path / "log.npz", ranges=np.arange(500.0), bearings=np.arange(500.0)
    )
    torn = tmp_path / "torn.npz"
    torn.write_bytes(whole.read_bytes()[:900])
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "array.npy", np.ones(3))
    array = (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    objects = save(tmp_path / "objects.npz", ranges=np.array([None, 1]))
    for path in (torn, tmp_path / "empty.npz", array, objects):
        with pytest.raises(ValueError, match="no readable .npz"):
            read_scans(path)
    (tmp_path / "log.csv").write_text("1,2,3")
    with pytest.raises(
        ValueError, match=r"cannot read log.csv: expected an .npz .* CARMEN"
    ):
        read_scans(tmp_path / "log.csv")
    with pytest.raises(ValueError, match="only rosbags have topics"):
        read_scans(whole, topic="/scan")


def test_scan_that_is_not_there_or_says_nothing(tmp_path):
    path = save(
        tmp_path / "log.npz", ranges=[[1.0, 2.0], [0.0, 0.0]], bearings=[0.0, 1.0]
    )
    log = read_scans(path)
    for index in (2, -3):
        with pytest.raises(ValueError, match=f"scans 0 to 1, there is no scan {index}"):
            log.scan(index)
    with pytest.raises(ValueError, match="scan 1 of the log: none of the 2 rays"):
        log.scan(1)


@pytest.mark.parametrize(
    ("name", "scans", "rays", "range_max"),
    [
        ("intel", 910, 180, 80.0),
        ("mac_turtlebot4_take2", 357, 720, 12.0),
        ("maebot_convex", 459, 310, 30.0),
        ("cmu_wean_log1", 713, 180, 80.0),
    ],
)
def test_real_npz(data, name, scans, rays, range_max):
    log = read_scans(data / "real" / f"{name}.npz")
    assert log.ranges.shape == (scans, rays)
    assert log.range_max == pytest.approx(range_max)
    assert log.scan(scans // 2).echo.sum() > rays // 2
