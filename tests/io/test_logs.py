import time

import jax
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
        (
            {"ranges": [1.0, 2.0], "bearings": [0.0, 1.0], "ray_stamp": [1.0]},
            r"`ray_stamp` .* must have shape \(1, 2\)",
        ),
        (
            {"ranges": [1.0], "bearings": [1.0], "ray_stamp": [np.nan]},
            "with a time in each scan",
        ),
        (
            {"ranges": [1.0], "bearings": [1.0], "odom": np.zeros((2, 3))},
            r"`odom` .* shape \(1, 3\), it has \(2, 3\)",
        ),
        (
            {
                "ranges": [1.0],
                "bearings": [1.0],
                "odom_base": np.zeros((1, 3)),
                "laser_in_base": [0.0, np.nan, 0.0],
            },
            "`laser_in_base` .* one finite pose",
        ),
    ],
)
def test_npz_that_is_no_log(tmp_path, arrays, message):
    with pytest.raises(ValueError, match=message):
        read_scans(save(tmp_path / "log.npz", **arrays))


def test_npz_odometry(tmp_path):
    base = np.array([[1.0, 2.0, np.pi / 2], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]])
    scans = {"ranges": np.ones((3, 4)), "bearings": np.arange(4.0)}
    mounting = {"laser_in_base": np.array([1.0, 0.0, np.pi / 2])}
    expected = [[1, 3, -np.pi], [np.nan] * 3, [1, 0, np.pi / 2]]
    missing = "1 of 3 scans have no odometry at their time"
    for key in ("odom_base", "odom"):
        log = read_scans(save(tmp_path / "a.npz", **scans, **mounting, **{key: base}))
        np.testing.assert_allclose(log.odometry, expected, atol=1e-9)
        assert log.remarks == (missing,)
    for key in ("odometry", "odom_laser"):
        given = {key: base, "odom_base": np.zeros((3, 3))}
        log = read_scans(save(tmp_path / "a.npz", **scans, **mounting, **given))
        np.testing.assert_array_equal(log.odometry[[0, 2]], base[[0, 2]])
        assert np.isnan(log.odometry[1]).all()
        assert log.remarks == (missing,)
    log = read_scans(save(tmp_path / "a.npz", **scans, odom=base))
    np.testing.assert_array_equal(log.odometry[0], base[0])
    assert "no `laser_in_base`: `odom` is taken as the lidar's" in log.remarks[0]
    assert read_scans(save(tmp_path / "a.npz", **scans)).odometry is None


def test_npz_times_of_the_rays(tmp_path):
    scans = {"ranges": np.ones((2, 3)), "bearings": np.arange(3.0)}
    rays = np.array([[1.0, 1.5, 2.0], [3.0, 3.5, np.nan]])
    log = read_scans(save(tmp_path / "a.npz", **scans, ray_stamp=rays))
    np.testing.assert_array_equal(log.stamps, [2, 3.5])
    np.testing.assert_array_equal(log.ray_times, [[-1, -0.5, 0], [-0.5, 0, 0]])
    log = read_scans(save(tmp_path / "a.npz", **scans, ray_stamp=rays, stamp=[1, 3]))
    np.testing.assert_array_equal(log.ray_times, [[0, 0.5, 1], [0, 0.5, 0]])
    log = read_scans(save(tmp_path / "a.npz", **scans, time_increment=0.25))
    np.testing.assert_array_equal(log.ray_times, [[0, 0.25, 0.5]] * 2)
    np.testing.assert_array_equal(log.reversed_sweep().ray_times, [[0.5, 0.25, 0]] * 2)
    log = read_scans(save(tmp_path / "a.npz", **scans, time_increment=0.0))
    assert log.ray_times is None
    with pytest.raises(ValueError, match="no times of rays"):
        log.reversed_sweep()


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
    with pytest.raises(ValueError, match="only rosbags have topics"):
        read_scans(whole, odometry_topic="/odom")


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


def test_many_scans_are_the_single_ones(tmp_path):
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0, 12, (30, 7))
    for dirt in (np.nan, np.inf, -np.inf, 0.0, 0.25, 10.0):
        ranges[rng.random(ranges.shape) < 0.1] = dirt
    path = save(
        tmp_path / "log.npz",
        ranges=ranges,
        bearings=rng.uniform(-3, 3, ranges.shape),
        range_min=0.25,
        range_max=10.0,
    )
    log = read_scans(path)
    for indices in (None, np.array([3, -1, 3]), [4]):
        scans = log.scans(indices)
        for row, i in enumerate(range(len(log)) if indices is None else indices):
            one, of_many = log.scan(int(i)), jax.tree.map(lambda x: x[row], scans)  # noqa: B023
            assert jax.tree.structure(one) == jax.tree.structure(of_many)
            for a, b in zip(
                jax.tree.leaves(one), jax.tree.leaves(of_many), strict=True
            ):
                assert a.dtype == b.dtype
                np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="scans 0 to 29, there is no scan 30"):
        log.scans(np.array([0, 30]))


def test_many_scans_may_hold_no_information():
    log = ScanLog(
        ranges=np.array([[1.0, 2.0], [0.0, np.nan]]),
        bearings=np.zeros((2, 2)),
        range_min=0.0,
        range_max=8.0,
        stamps=None,
    )
    for indices, rows in ((None, 1), (np.array([1]), 0)):
        scans = log.scans(indices)
        assert not scans.valid[rows].any()
        assert not scans.echo[rows].any()
        np.testing.assert_array_equal(scans.ranges[rows], [8, 8])
    assert log.scans(np.array([], int)).ranges.shape == (0, 2)


def test_many_scans_are_fast(data):
    log = read_scans(data / "real" / "intel_dense.npz")
    log.scans(np.arange(2))
    start = time.perf_counter()
    scans = jax.block_until_ready(log.scans())
    assert time.perf_counter() - start < 2.0
    assert scans.ranges.shape == (13_631, 180)
    assert scans.range_max.shape == (13_631,)
    assert log.odometry.shape == (13_631, 3)


def test_real_npz_with_odometry_and_times(data):
    log = read_scans(data / "real" / "maebot_convex.npz")
    assert log.odometry is None
    assert log.ray_times.max() == 0
    assert -0.16 < log.ray_times.min() < -0.14
    assert (np.diff(log.stamps) > 0.1).all()
    log = read_scans(data / "real" / "mac_turtlebot4_take2.npz")
    with np.load(data / "real" / "mac_turtlebot4_take2.npz") as prepared:
        np.testing.assert_array_equal(log.odometry, prepared["odom_laser"])
    assert log.ray_times.max() == pytest.approx(0.134, abs=1e-3)
    assert not log.remarks


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
