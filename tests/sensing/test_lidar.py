import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.sensing import Lidar, Scan

NAN, INF = np.nan, np.inf


def test_three_kinds_of_rays_are_told_apart():
    dirty = [1.0, NAN, INF, -INF, 0.0, -2.0, 0.05, 0.1, 7.999, 8.0, 9.0, 65.533]
    scan = Scan.from_ranges(dirty, 0.5, 0.1, range_min=0.1, range_max=8.0)
    valid = [1, 0, 1, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    echo = [1, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0]
    np.testing.assert_array_equal(scan.valid, valid)
    np.testing.assert_array_equal(scan.echo, echo)
    expected = np.where(echo, np.nan_to_num(dirty, posinf=0, neginf=0), 8.0)
    np.testing.assert_allclose(scan.ranges, expected)
    np.testing.assert_allclose(scan.bearings, 0.5 + 0.1 * np.arange(12), rtol=1e-6)
    assert scan.range_max == 8.0


@pytest.mark.parametrize("kind", [list, np.asarray, jnp.asarray, np.float32])
def test_any_row_of_numbers_is_taken(kind):
    scan = Scan.from_ranges(kind([1.0, 2.0, NAN]), 0, 1)
    np.testing.assert_array_equal(scan.ranges, [1, 2, 30])
    assert scan.ranges.dtype == jnp.float32


def test_integer_ranges_are_taken():
    assert Scan.from_ranges(np.array([1, 0, 3]), 0.0, 1.0).valid.sum() == 2


@pytest.mark.parametrize(
    ("start", "step"),
    [(0.0, np.pi / 2), (-np.pi, np.pi / 2), (np.pi, -np.pi / 2), (7.0, 0.3)],
)
def test_points_lie_where_the_layout_says(start, step):
    ranges = np.array([1.0, 2.0, 3.0, 4.0])
    scan = Scan.from_ranges(ranges, start, step)
    angles = start + step * np.arange(4)
    expected = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    np.testing.assert_allclose(scan.points, expected, atol=2e-6)


def test_bearings_in_any_order():
    scan = Scan.from_bearings([1.0, 2.0], [np.pi / 2, -3.0])
    np.testing.assert_allclose(scan.points[0], [0, 1], atol=1e-6)
    same = Scan.from_ranges([1.0, 2.0], np.pi / 2, -3.0 - np.pi / 2)
    np.testing.assert_allclose(scan.points, same.points, atol=1e-6)


def test_a_scan_of_nothing_but_free_space_is_valid():
    scan = Scan.from_ranges(np.full(9, INF), 0.0, 0.1, 0.1, 12.0)
    assert scan.valid.all()
    assert not scan.echo.any()
    np.testing.assert_array_equal(scan.ranges, 12.0)


ONES = np.ones(4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ranges": np.zeros(0)}, r"non-empty row of ranges, got shape \(0,\)"),
        ({"ranges": np.ones((2, 4))}, r"one non-empty row .* \(2, 4\)"),
        ({"ranges": np.full(4, NAN)}, "none of the 4 rays .* units .* driver"),
        ({"ranges": np.zeros(4)}, "none of the 4 rays"),
        ({"ranges": np.full(4, -INF)}, "none of the 4 rays"),
        ({"ranges": ONES * 0.05}, "range_min = 0.1"),
        ({"angle_min": NAN}, "must be finite .* got nan"),
        ({"angle_increment": INF}, "must be finite"),
        ({"angle_increment": 0.0}, "increment not 0"),
        ({"range_min": -1.0}, "0 ≤ range_min < range_max, got -1"),
        ({"range_min": NAN}, "0 ≤ range_min < range_max"),
        ({"range_max": 0.1}, "0 ≤ range_min < range_max"),
        ({"range_max": INF}, "0 ≤ range_min < range_max, got 0.1 and inf"),
        ({"range_max": NAN}, "0 ≤ range_min < range_max"),
    ],
)
def test_bad_scans_are_refused(arguments, message):
    good = dict(
        ranges=ONES, angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=9.0
    )
    with pytest.raises(ValueError, match=message):
        Scan.from_ranges(**(good | arguments))


@pytest.mark.parametrize(
    ("bearings", "message"),
    [
        (np.ones(3), r"expected shape \(4,\), got \(3,\)"),
        (np.ones((4, 1)), r"got \(4, 1\)"),
        (np.array([0.0, NAN, INF, 1.0]), "2 bearings are not finite"),
    ],
)
def test_bad_bearings_are_refused(bearings, message):
    with pytest.raises(ValueError, match=message):
        Scan.from_bearings(ONES, bearings)


def test_real_dirty_logs(data):
    for path in sorted((data / "logs").glob("ydlidar_x4_*.npz")):
        log = np.load(path)
        for turn in range(len(log["n"])):
            rays = int(log["n"][turn])
            row = log["ranges"][turn, :rays]
            if not (row > 0.1).any():
                with pytest.raises(ValueError, match="holds information"):
                    Scan.from_ranges(row, 0.0, -2 * np.pi / rays, 0.1, 12.0)
                continue
            if turn % 40:
                continue
            scan = Scan.from_ranges(row, 0.0, -2 * np.pi / rays, 0.1, 12.0)
            valid, echo = np.asarray(scan.valid), np.asarray(scan.echo)
            np.testing.assert_array_equal(valid, row >= 0.1)
            np.testing.assert_array_equal(echo, (row >= 0.1) & (row < 12))
            np.testing.assert_array_equal(np.asarray(scan.ranges)[echo], row[echo])


# ---- Lidar -------------------------------------------------------------------------


@pytest.mark.parametrize("rays", [3, 7, 360])
def test_a_full_circle_has_no_direction_twice(rays):
    bearings = Lidar.create(rays=rays).bearings
    expected = -np.pi + 2 * np.pi * np.arange(rays) / rays
    np.testing.assert_allclose(bearings, expected, atol=1e-6)


def test_a_partial_view_includes_both_edges():
    bearings = Lidar.create(rays=181, field_of_view=np.pi).bearings
    np.testing.assert_allclose(bearings[::90], [-np.pi / 2, 0, np.pi / 2], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rays": 2}, "at least 3 rays, got 2"),
        ({"field_of_view": 0.0}, "field_of_view"),
        ({"field_of_view": 7.0}, "field_of_view must lie in .* got 7"),
        ({"field_of_view": NAN}, "field_of_view"),
        ({"range_max": 0.0}, "range_max > 0"),
        ({"range_max": INF}, "range_max > 0"),
        ({"noise": -0.1}, "noise ≥ 0"),
        ({"noise": NAN}, "noise ≥ 0"),
        ({"dropout": 1.1}, "probabilities"),
        ({"outliers": -0.1}, "probabilities"),
    ],
)
def test_bad_lidars_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Lidar.create(**arguments)


RAYS = 40_000
KEY = jax.random.key(3)


def near(share, expected):
    """Within four standard errors of a share of `RAYS` coin flips."""
    return abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / RAYS)


def test_noise_has_its_standard_deviation_and_no_bias():
    scan = Lidar.create(rays=RAYS, noise=0.05).measure(KEY, jnp.full(RAYS, 7.0))
    error = np.asarray(scan.ranges, float) - 7
    assert scan.echo.all()
    assert abs(error.mean()) < 4 * 0.05 / np.sqrt(RAYS)
    assert abs(error.std() - 0.05) < 4 * 0.05 / np.sqrt(2 * RAYS)


def test_a_perfect_lidar_reports_what_is_there():
    exact = jnp.linspace(0.5, 30.0, RAYS)
    scan = Lidar.create(rays=RAYS, noise=0.0).measure(KEY, exact)
    np.testing.assert_array_equal(scan.ranges, exact)
    np.testing.assert_array_equal(scan.echo, exact < 30.0)
    assert scan.valid.all()


def test_dropout_and_outliers_come_as_often_as_asked():
    lidar = Lidar.create(rays=RAYS, noise=0.01, dropout=0.2, outliers=0.3)
    scan = lidar.measure(KEY, jnp.full(RAYS, 7.0))
    assert near(np.mean(~scan.valid), 0.2)
    short = np.asarray(scan.ranges)[np.asarray(scan.echo)] < 6.9
    # 1 in 70 unmapped things stands within 0.1 m of the wall.
    assert near(short.mean(), 0.3 * (6.9 / 7 - 0.02) / 0.98)
    assert np.asarray(scan.ranges).min() > 0


def test_no_echo_stays_no_echo_unless_something_stands_in_the_way():
    exact = jnp.full(RAYS, 30.0)
    plain = Lidar.create(rays=RAYS, noise=0.05).measure(KEY, exact)
    assert plain.valid.all()
    assert not plain.echo.any()
    np.testing.assert_array_equal(plain.ranges, 30.0)
    crowd = Lidar.create(rays=RAYS, noise=0.05, outliers=0.3).measure(KEY, exact)
    assert near(np.mean(crowd.echo), 0.3)


def test_readings_noise_pushed_out_of_reach_are_told_apart():
    lidar = Lidar.create(rays=RAYS, noise=0.05, range_max=10.0)
    far = lidar.measure(KEY, jnp.full(RAYS, 9.99))
    assert 0.3 < np.mean(~far.echo) < 0.5  # one noise in 0.42 exceeds +0.2 σ
    assert far.valid.all()
    assert far.ranges.max() == 10.0
    close = lidar.measure(KEY, jnp.full(RAYS, 0.01))
    assert not close.valid.all()
    assert (close.ranges > 0).all()
    assert not (close.echo & ~close.valid).any()


def test_seeds_sweep_by_vmap_and_repeat():
    lidar = Lidar.create(rays=90, noise=0.05, dropout=0.1, outliers=0.1)
    exact = jnp.linspace(1.0, 9.0, 90)
    keys = jax.random.split(KEY, 3)
    many = jax.jit(jax.vmap(lidar.measure, (0, None)))(keys, exact)
    again = lidar.measure(keys[1], exact)
    np.testing.assert_allclose(many.ranges[1], again.ranges, rtol=1e-6)
    assert (many.ranges[0] != many.ranges[1]).mean() > 0.5
