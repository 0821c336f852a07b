import math

import numpy as np
import pytest
from scipy.io import savemat

from fsmsm_jax.io.acfr import bright_poles, read_carpark, read_victoria_park
from fsmsm_jax.io.drive_npz import read_drive_npz, write_drive_npz
from fsmsm_jax.io.frames import chain
from fsmsm_jax.io.landmarks import LandmarkLog, cut_at_looks, read_landmark_log
from fsmsm_jax.io.mrclam import read_mrclam
from fsmsm_jax.io.tables import read_mat, read_table
from fsmsm_jax.slam.drive import tidied
from fsmsm_jax.slam.sensor import RangeBearing
from fsmsm_jax.slam.vehicle import Car, DiffDrive

NOTHING = np.zeros((0, 3))


def durations_add_up(log):
    # Times are of the order of 1e3 s in double precision: 1e-9 s is rounding.
    np.testing.assert_allclose(
        log.drive.controls[1:, :, 2].sum(1), np.diff(log.times), atol=1e-9
    )
    assert log.drive.controls[0, :, 2].sum() == 0


def stream(rng, n=40, first=2.0):
    times = first + np.cumsum(rng.uniform(0.01, 0.3, n))
    return np.column_stack([times, rng.normal(2.0, 1.0, n), rng.normal(0.0, 0.3, n)])


def held_in(controls, begin, end):
    """What the overlap of each control's reign with a step says: slow and obvious."""
    rows = []
    reigns = [*controls[:, 0], np.inf]
    if begin < reigns[0]:
        rows.append([0.0, 0.0, min(end, reigns[0]) - begin])
    for (_, speed, steering), since, until in zip(
        controls, reigns[:-1], reigns[1:], strict=True
    ):
        overlap = min(end, until) - max(begin, since)
        if overlap > 0:
            rows.append([speed, steering, overlap])
    return np.array(rows)


def test_controls_are_cut_exactly_at_the_looks():
    rng = np.random.default_rng(0)
    controls = stream(rng)
    looks = np.sort(
        rng.uniform(1.0, 9.0, 25)
    )  # from before the first to after the last
    looks[7] = looks[6]
    drive, times, remarks = cut_at_looks(controls, looks, NOTHING)
    np.testing.assert_array_equal(times, looks)
    assert remarks == ()
    assert drive.controls[0, :, 2].sum() == drive.controls[7, :, 2].sum() == 0
    widest = 0
    for step in range(1, len(looks)):
        rows = drive.controls[step][drive.controls[step, :, 2] > 0]
        expected = held_in(controls, looks[step - 1], looks[step]).reshape(-1, 3)
        np.testing.assert_allclose(rows, expected, atol=1e-12)
        widest = max(widest, len(rows))
    assert drive.controls.shape == (25, widest, 3)


def test_disorder_is_sorted_and_said():
    rng = np.random.default_rng(1)
    controls, looks = stream(rng), np.sort(rng.uniform(2.0, 8.0, 9))
    found = np.column_stack([rng.integers(0, 9, 20), rng.uniform(1, 9, (20, 2))])
    found[:, 2] /= 9
    ids = np.arange(20)
    drive, times, _ = cut_at_looks(controls, looks, found, ids)
    turned = found.copy()
    turned[:, 0] = 8 - found[:, 0]
    mixed, sorted_times, remarks = cut_at_looks(
        controls[::-1], looks[::-1], turned, ids
    )
    np.testing.assert_array_equal(sorted_times, times)
    for one, other in zip(mixed, drive, strict=True):
        np.testing.assert_array_equal(one, other)
    assert "controls go back 39 times" in remarks[0]
    assert "looks go back 8 times" in remarks[1]


def test_each_detection_is_at_its_look_and_padding_is_no_wider_than_needed():
    looks = np.array([1.0, 2.0, 3.0])
    found = np.array([[2, 5.0, 0.1], [0, 4.0, -0.2], [2, 6.0, 4.0], [2, 0.0, 0.0]])
    drive, _, _ = cut_at_looks(
        np.array([[0.0, 1.0, 0.0]]), looks, found, np.array([3, 1, 4, 0])
    )
    assert drive.detections.shape == (3, 3, 2)
    np.testing.assert_array_equal(
        drive.valid, [[1, 0, 0], [0, 0, 0], [1, 1, 0]]
    )  # zero range is no detection
    np.testing.assert_array_equal(drive.ids[2, :2], [3, 4])
    np.testing.assert_array_equal(drive.ids[0], [1, -1, -1])
    np.testing.assert_allclose(drive.detections[2, 1], [6.0, 4.0 - 2 * math.pi])


def test_nan_steering_is_held_and_said():
    controls = np.array(
        [[0.0, 1.0, 0.1], [1.0, 1.0, np.nan], [np.nan, 9.0, 9.0], [2.0, np.inf, 0.3]]
    )
    drive, _, remarks = cut_at_looks(controls, np.array([0.0, 3.0]), NOTHING)
    np.testing.assert_allclose(drive.controls[1], [[1.0, 0.1, 1.0]] * 3)
    assert "1 controls have no time" in remarks[0]
    assert "2 controls are not finite" in remarks[1]


@pytest.mark.parametrize(
    ("controls", "looks"),
    [
        (NOTHING, np.array([1.0])),
        (np.array([[0.0, 1.0, 0.0]]), np.zeros(0)),
        (np.array([[np.nan, 1.0, 0.0]]), np.array([1.0])),
        (np.array([[0.0, 1.0, 0.0]]), np.array([1.0, np.nan])),
    ],
)
def test_nothing_to_cut_is_an_error(controls, looks):
    with pytest.raises(ValueError, match="time"):
        cut_at_looks(controls, looks, NOTHING)


def test_tables(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# t,x\n1,2,3\n 4 \t 5 6\n\n,,\n7,nan,8\n9,1")
    np.testing.assert_array_equal(
        read_table(path, 2), [[1, 2], [4, 5], [7, np.nan], [9, 1]]
    )
    np.testing.assert_array_equal(read_table(path, 3)[:, 0], [1, 4, 7])  # torn last
    path.write_text("1,2\n3\n4,5\n")
    with pytest.raises(ValueError, match="line 2: expected 2 numbers"):
        read_table(path, 2)
    path.write_text("# only\n")
    with pytest.raises(ValueError, match="holds no rows"):
        read_table(path, 2)
    with pytest.raises(ValueError, match="no file"):
        read_table(tmp_path / "b.csv", 2)


def test_mat_files(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"x": np.arange(400.0), "y": 1.0}, do_compression=True)
    assert read_mat(path, ["x"])["x"].shape == (1, 400)
    with pytest.raises(ValueError, match=r"lacks \['z'\]; it holds \['x', 'y'\]"):
        read_mat(path, ["z"])
    whole = path.read_bytes()
    for torn in (whole[: len(whole) // 2], b"", b"no such thing" * 40):
        path.write_bytes(torn)
        with pytest.raises(ValueError, match=r"torn|lacks"):
            read_mat(path, ["x", "y"])
    with pytest.raises(ValueError, match="no file"):
        read_mat(tmp_path / "b.mat", ["x"])


def test_poles_against_a_loop():
    rng = np.random.default_rng(2)
    ranges = rng.uniform(0.5, 40.0, (30, 361))
    bright = (rng.random(ranges.shape) < 0.1) * 8192
    expected = []
    for scan in range(30):
        group = []
        for ray in [*range(361), 1000]:
            if group and ray - group[-1] > 3:
                r = sorted(ranges[scan, group])
                middle = (r[(len(r) - 1) // 2] + r[len(r) // 2]) / 2
                expected.append((scan, middle, np.deg2rad(np.mean(group) / 2 - 90)))
                group = []
            if ray < 361 and bright[scan, ray] and 1 < ranges[scan, ray] < 30:
                group.append(ray)
    np.testing.assert_allclose(bright_poles(ranges, bright), expected, atol=1e-12)


def carpark(folder, seconds=130.0):
    """A drive past two poles, as the recording and as tables."""
    odometry = np.arange(40.0, 40.0 + seconds, 0.025)
    gps, laser = odometry[1::8] + 0.003, odometry[3::8] + 0.01
    fixes = np.column_stack([gps, 5 + gps, 7 - gps])
    ranges, bright = np.full((len(laser), 361), 81.9), np.zeros((len(laser), 361), int)
    ranges[:, 100], bright[:, 100] = 6.5, 8192
    ranges[::2, 300], bright[::2, 300] = 12.25, 16384
    bright[3] = 0  # a look that finds nothing
    moves = np.column_stack([odometry, 2 + 0 * odometry, 0.1 * np.sin(odometry)])
    beacons = np.array([[3.0, 4.0], [-1.0, 2.0]])
    names = ("Time_VS", "Velocity", "Steering"), ("TimeGPS", "GPSLon", "GPSLat")
    tables = [
        {n: c[None] for n, c in zip(keys, table.T, strict=True)}
        for keys, table in zip(names, (moves, fixes), strict=True)
    ]
    scans = {"TimeLaser": laser[None], "Laser": ranges, "Intensity": bright}
    original, derived = folder / "original", folder / "derived"
    original.mkdir()
    derived.mkdir()
    savemat(original / "data_set.mat", tables[0] | tables[1] | scans)
    savemat(original / "beac_juan3.mat", {"estbeac": beacons})
    found = bright_poles(ranges, bright)
    numbers = found[:, 0].astype(int)
    ids = np.where(found[:, 2] > 0, 1, 0)
    ids[-1] = -1
    rows = np.column_stack([laser[numbers] - 40.0, found, np.ones(len(found)), ids])
    for place in (original, derived):
        np.savetxt(
            place / "detections_with_beacon_id.csv", rows, "%.4f", ",", header="t, …"
        )
    moves[:, 0] -= 40.0
    fixes[:, 0] -= 40.0
    np.savetxt(derived / "odometry.csv", moves, "%.9f", ",")
    np.savetxt(derived / "gps.csv", fixes, "%.9f", ",")
    np.savetxt(derived / "beacons_gps_surveyed.csv", beacons, "%.4f", ",")
    return original, derived


def test_carpark_from_the_recording_and_from_tables(tmp_path):
    original, derived = carpark(tmp_path)
    log, table = read_landmark_log(original / "data_set.mat"), read_carpark(derived)
    for one in (log, table):
        durations_add_up(one)
        assert one.times[-1] < 112
        assert one.reference[-1, 0] <= one.times[-1]
        np.testing.assert_allclose(one.landmarks, [[3.0, 4.0], [-1.0, 2.0]])
        # 1e-4: the tables are written so.
        t = one.times[0] + 40
        np.testing.assert_allclose(
            one.start, [5 + t, 7 - t, math.radians(-128)], atol=1e-4
        )
    assert len(table.times) == len(log.times) - 1  # the look that found nothing
    np.testing.assert_allclose(log.times[0], 0.085)
    seen = log.drive.detections[log.drive.valid]
    np.testing.assert_allclose(
        seen, table.drive.detections[table.drive.valid], atol=1e-4
    )
    np.testing.assert_allclose(
        log.drive.detections[0], [[6.5, -math.radians(40)], [12.25, math.radians(60)]]
    )
    np.testing.assert_array_equal(log.drive.ids[:2], [[0, 1], [0, -1]])
    assert not log.drive.valid[3].any()

    (original / "detections_with_beacon_id.csv").unlink()
    (original / "beac_juan3.mat").unlink()
    blind = read_carpark(original, until=20.0)
    assert np.all(blind.drive.ids == -1)
    assert blind.landmarks is None
    assert 19.5 < blind.times[-1] < 20
    with (derived / "odometry.csv").open("a") as file:
        file.write("130.0,2.")  # the recorder was switched off
    assert np.all(np.isfinite(read_carpark(derived, until=1e3).drive.controls))
    (derived / "gps.csv").unlink()
    with pytest.raises(ValueError, match=r"no file .*gps\.csv"):
        read_carpark(derived)


def test_carpark_that_does_not_fit(tmp_path):
    original, _ = carpark(tmp_path, 5.0)
    names = ("Time_VS", "Velocity", "Steering", "TimeGPS", "GPSLon", "GPSLat")
    good = read_mat(
        original / "data_set.mat", (*names, "TimeLaser", "Laser", "Intensity")
    )
    for name, message in (("Steering", "one length"), ("TimeLaser", "do not fit")):
        savemat(original / "data_set.mat", good | {name: good[name][:, :-3]})
        with pytest.raises(ValueError, match=message):
            read_carpark(original)


def victoria_park(folder, **changes):
    odometry = np.arange(21.94, 31.94, 0.025)
    cells = np.empty((1, 40), object)
    for i in range(40):
        cells[0, i] = np.array([[20.0, 5.0], [0.3, math.pi / 2 + 0.2], [0.3, 0.4]])
    cells[0, 3] = np.zeros((0, 0))
    moves = np.vstack([2 + 0 * odometry, 0.1 * np.sin(odometry)])
    data = {"time": odometry[None], "u": moves, "zt": cells}
    data |= {"TLsr": 21.82 + 0.2137 * np.arange(40.0)[None]} | changes
    savemat(folder / "VictoriaParkSinSincronizar.mat", data)


def test_victoria_park(tmp_path):
    victoria_park(tmp_path)
    log = read_landmark_log(tmp_path)
    durations_add_up(log)
    assert log.reference.shape == (0, 3)
    np.testing.assert_allclose(  # beams are counted from the right
        log.drive.detections[0], [[20.0, 0.3 - math.pi / 2], [5.0, 0.2]]
    )
    assert not log.drive.valid[3].any()
    assert np.all(log.drive.valid[4])
    np.testing.assert_allclose(  # it stands until its first control
        log.drive.controls[1, :2, [0, 2]].T, [[0.0, 0.12], [2.0, 0.025]], atol=1e-9
    )
    stamps = np.array([[21000], [23000], [22000]], np.int32)
    savemat(
        tmp_path / "aa3_gpsx.mat",
        {"timeGps": stamps, "Lo_m": stamps / 10.0, "La_m": np.array([1, np.nan, 3])},
    )
    log = read_victoria_park(tmp_path, until=25.0)
    assert log.times[-1] < 25
    np.testing.assert_array_equal(log.reference, [[21, 2100, 1], [22, 2200, 3]])
    with pytest.raises(ValueError, match="no look before 20"):
        read_victoria_park(tmp_path, until=20.0)
    victoria_park(tmp_path, TLsr=np.arange(39.0))
    with pytest.raises(ValueError, match="39 cells zt"):
        read_victoria_park(tmp_path)


def mrclam(folder, robots=(3,), gap=40):
    times = np.arange(0.0, 1010.0, 0.02)
    rounded = np.array([float(f"{t:.5g}") for t in times])
    heading = np.angle(np.exp(0.1j * times))
    heading[500] += 1.0  # as where averaging went wrong
    truth = np.column_stack([rounded, 1 + 0.004 * times, 2 - 0 * times, heading])
    looks = np.arange(-1.0, 1009.0, 0.2)
    looks = np.delete(looks, np.arange(100, 100 + gap))
    looks[5] = np.nan
    code = np.array([63, 25, 5])[np.arange(len(looks)) % 3]  # of landmarks and a robot
    seen = np.column_stack([looks, code, 2 + 0.01 * code, 0.3 + 0 * looks])
    folder.joinpath("Barcodes.dat").write_text("# s c\n 1 5\n 6 63\n 7 25\n")
    folder.joinpath("Landmark_Groundtruth.dat").write_text(
        "# s x y\n 7 1.5 2.5 0 0\n 6 -3.5 4.0 0 0\n"
    )
    for n in robots:
        save = lambda kind, rows, n=n: np.savetxt(
            folder / f"Robot{n}_{kind}.dat", rows, "%.5g"
        )
        save("Odometry", np.column_stack([rounded, 0.1 + 0 * times, 0.1 + 0 * times]))
        save("Groundtruth", truth)
        save("Measurement", seen)


def test_mrclam(tmp_path):
    mrclam(tmp_path)
    log = read_landmark_log(tmp_path)
    durations_add_up(log)
    assert isinstance(log.vehicle, DiffDrive)
    np.testing.assert_array_equal(log.landmarks, [[1.5, 2.5], [-3.5, 4.0]])
    seen, ids = log.drive.detections[log.drive.valid], log.drive.ids[log.drive.valid]
    np.testing.assert_allclose(seen[:, 0], np.where(ids == 1, 2.63, 2.25))
    assert set(ids) == {0, 1}
    assert 0 <= log.times[0] < 0.5  # no look before truth begins
    # Five digits leave 0.05 s after 1000 s; evened out, the truth is where it was.
    np.testing.assert_allclose(np.diff(log.reference[:, 0]), 0.02, atol=1e-9)
    np.testing.assert_allclose(
        log.reference[:, 1], 1 + 0.004 * log.reference[:, 0], atol=1e-4
    )
    assert np.flatnonzero(np.isnan(log.headings)).tolist() == [499, 500, 501]
    t = log.times[0]
    np.testing.assert_allclose(log.start, [1 + 0.004 * t, 2.0, 0.1 * t], atol=1e-4)
    assert np.diff(log.times).max() <= 0.5 + 1e-9
    assert log.drive.controls.shape[1] <= 27
    late = log.drive.controls[log.times > 1001, :, 2]
    assert np.median(np.sum(late > 0, axis=1)) >= 10  # 0.2 s at 50 Hz, not at 10
    assert not log.drive.valid[np.searchsorted(log.times, 23.0)].any()


def test_mrclam_of_several_robots_and_strange_barcodes(tmp_path):
    mrclam(tmp_path, robots=(1, 4))
    with pytest.raises(ValueError, match=r"got None; there are \[1, 4\]"):
        read_mrclam(tmp_path)
    with pytest.raises(ValueError, match="got 2"):
        read_mrclam(tmp_path, 2)
    assert read_mrclam(tmp_path, 4).drive.valid.any()
    (tmp_path / "Barcodes.dat").write_text("1 5\n6 63\n")
    with pytest.raises(ValueError, match=r"barcodes \[25\]"):
        read_mrclam(tmp_path, 4)


def small_log(vehicle, **changes):
    rng = np.random.default_rng(3)
    controls = rng.uniform(0.1, 1.0, (4, 3, 3))
    seen = rng.uniform(0.5, 3.0, (4, 2, 2))
    valid = rng.random((4, 2)) < 0.5
    ids = rng.integers(-1, 5, (4, 2))
    log = LandmarkLog(
        tidied(controls, seen, valid, ids),
        np.array([3.0, 3.5, 3.5, 9.0]),
        np.array([1.0, -2.0, 0.5]),
        vehicle,
        RangeBearing((0.2, 0.03), 12.0, 1.0),
        rng.normal(size=(5, 3)),
    )
    return log._replace(**changes)


@pytest.mark.parametrize(
    "log",
    [
        small_log(Car(2.5, 0.3, (1.0, -0.2), (0.1, 0.02), (1.1, 0.2), True)),
        small_log(
            DiffDrive((0.3, 0.4)), headings=np.arange(5.0), landmarks=np.ones((3, 2))
        ),
    ],
)
def test_npz_comes_back_as_it_went(tmp_path, log):
    write_drive_npz(tmp_path / "a.npz", log)
    back = read_landmark_log(tmp_path / "a.npz")
    assert back.vehicle == log.vehicle
    assert back.sensor == log.sensor
    for name in ("times", "start", "reference", "headings", "landmarks"):
        one, other = getattr(back, name), getattr(log, name)
        assert (one is None) == (other is None)
        if other is not None:
            np.testing.assert_array_equal(one, other)
    for one, other in zip(back.drive, log.drive, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype


def test_npz_needs_three_arrays_only(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        controls=np.ones((2, 1, 3)),
        detections=np.array([[[0.0, 1.0]], [[4.0, 1.0]]]),
        times=np.array([0, 1]),
    )
    log = read_drive_npz(tmp_path / "a.npz")
    assert log.vehicle == DiffDrive()
    assert log.drive.valid[:, 0].tolist() == [False, True]
    assert log.start.tolist() == [0, 0, 0]
    assert log.headings is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": None}, r"lacks \['times'\]"),
        ({"times": np.array([0.0, 2.0, 1.0, 3.0])}, "not go back"),
        ({"times": np.array([0.0, 1.0, np.nan, 3.0])}, "must be finite"),
        ({"times": np.arange(3.0)}, r"`controls` of a.npz must have shape \(3,"),
        ({"controls": np.ones((4, 3))}, "`controls`"),
        ({"controls": -np.ones((4, 3, 3))}, "less than zero seconds"),
        ({"detections": np.ones((4, 2, 3))}, "`detections`"),
        ({"valid": np.ones((4, 3))}, "`valid`"),
        ({"ids": np.full((4, 2), -3)}, "ids from 0"),
        ({"ids": np.full((4, 2), "tree")}, "real numbers"),
        ({"ids": np.full((4, 2), np.nan)}, "`ids` of a.npz must be finite"),
        ({"start": np.array([0.0, np.nan, 0.0])}, "finite pose"),
        ({"reference": np.ones((5, 2))}, "`reference`"),
        ({"headings": np.ones(4)}, "`headings`"),
        ({"wheel_base": np.array(0.0)}, "above 0"),
        ({"tracked": np.ones(3)}, "`tracked`"),
        ({"detection_noise": np.array([0.1, 0.0])}, "above 0"),
        ({"reach": np.array(np.nan)}, "`reach`"),
        ({"landmarks": np.array([{"tree": 1}], object)}, "no readable"),
    ],
)
def test_npz_that_makes_no_sense(tmp_path, changes, message):
    path = tmp_path / "a.npz"
    write_drive_npz(path, small_log(Car()))
    arrays = dict(np.load(path)) | changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(ValueError, match=message):
        read_drive_npz(path)


def test_what_is_no_log(tmp_path):
    with pytest.raises(ValueError, match=r"there is no log at .*: expected a folder"):
        read_landmark_log(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"cannot tell .* found nothing"):
        read_landmark_log(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(ValueError, match=r"cannot tell .* found \['notes.txt'\]"):
        read_landmark_log(tmp_path / "notes.txt")
    (tmp_path / "a.npz").write_text("hello")
    with pytest.raises(ValueError, match="no readable"):
        read_landmark_log(tmp_path / "a.npz")


# --- the recordings -----------------------------------------------------------------


def poses_by_odometry(log):
    """Poses of the tracked point at the looks, each control an arc's chord."""
    speed, turn, seconds = np.moveaxis(log.drive.controls, -1, 0)
    if isinstance(log.vehicle, Car):
        car = log.vehicle
        curve = np.tan(turn) / car.wheel_base
        speed = speed / (1 - car.wheel_offset * curve)
        turn = speed * curve
        ahead, left = speed - turn * car.tracked[1], turn * car.tracked[0]
    else:
        ahead, left = speed, 0 * speed
    moves = np.stack([ahead, left, turn], -1) * seconds[..., None]
    moves = moves.reshape(-1, 3)
    half = moves[:, 2] / 2
    c, s = np.cos(half), np.sin(half)
    x, y = c * moves[:, 0] - s * moves[:, 1], s * moves[:, 0] + c * moves[:, 1]
    poses = chain(log.start, np.column_stack([x, y, moves[:, 2]]))
    return poses[log.drive.controls.shape[1] :: log.drive.controls.shape[1]]


def reference_at_looks(log):
    return np.column_stack(
        [np.interp(log.times, log.reference[:, 0], log.reference[:, i]) for i in (1, 2)]
    )


def test_carpark_recording(data):
    folder = data / "slam" / "carpark"
    log = read_carpark(folder)
    durations_add_up(log)
    assert log.drive.valid.sum() == 818
    assert (log.drive.ids[log.drive.valid] >= 0).all()
    scans = read_mat(folder / "data_set.mat", ["Laser", "Intensity"])
    poles = bright_poles(scans["Laser"], scans["Intensity"])
    table = read_table(folder / "detections.csv", 4)
    assert len(poles) == len(table) == 888
    np.testing.assert_allclose(poles, table[:, 1:], atol=1.1e-4)  # rounded to 1e-4

    # GPS and survey are good to 2 cm each, the poles' ranges to 3: no lever arm.
    places = reference_at_looks(log)
    step, slot = np.nonzero(log.drive.valid)
    seen = log.drive.detections[step, slot]
    towards = log.landmarks[log.drive.ids[step, slot]] - places[step]
    off = seen[:, 0] - np.hypot(*towards.T)
    assert np.median(np.abs(off)) < 0.04
    assert np.percentile(np.abs(off), 98) < 0.15
    # Headings by two poles of one look agree to 2 σ √2 of 0.01 rad, left being left.
    heading = np.arctan2(towards[:, 1], towards[:, 0]) - seen[:, 1]
    same = np.flatnonzero(np.diff(step) == 0)
    apart = np.angle(np.exp(1j * (heading[same + 1] - heading[same])))
    assert len(same) > 300
    assert np.percentile(np.abs(apart), 95) < 0.04
    # Dead reckoning, 23 m in ten seconds, steering 0.006 rad off: 1.02 m.
    first = log.times < log.times[0] + 10
    away = np.hypot(*(poses_by_odometry(log)[first, :2] - places[first]).T)
    assert away.max() < 1.2


def test_carpark_tables_say_the_same(data, tmp_path):
    folder = data / "slam" / "carpark"
    for file in folder.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    log, table = read_carpark(folder), read_landmark_log(tmp_path)
    durations_add_up(table)
    np.testing.assert_allclose(table.landmarks, log.landmarks, atol=1e-4)
    np.testing.assert_allclose(table.start, log.start, atol=1e-3)
    assert set(np.round(table.times, 3)) <= set(np.round(log.times, 3))
    np.testing.assert_array_equal(
        table.drive.ids[table.drive.valid], log.drive.ids[log.drive.valid]
    )


def test_victoria_park_recording(data):
    log = read_victoria_park(data / "slam" / "victoria_park", until=220.0)
    durations_add_up(log)
    # 500 m of dead reckoning, the steering mended as the module says; unmended, 61 m.
    controls = log.drive.controls * [1.0, 1.036, 1.0] + [0.0, 0.0055, 0.0]
    mended = log._replace(drive=log.drive._replace(controls=controls))
    poses = poses_by_odometry(mended)
    away = np.hypot(*(poses[:, :2] - reference_at_looks(log)).T)
    fixed = np.abs(log.times[:, None] - log.reference[None, :, 0]).min(1) < 0.1
    assert np.sum(fixed) > 500
    assert away[fixed].max() < 10

    def met(mirrored):
        """Share of trees that are found again a second later where they were."""
        z = log.drive.detections
        bearing = -z[..., 1] if mirrored else z[..., 1]
        angle = poses[:, None, 2] + bearing
        spot = poses[:, None, :2] + z[..., :1] * np.stack(
            [np.cos(angle), np.sin(angle)], -1
        )
        again, of = 0, 0
        for k in range(100, len(z) - 5, 5):
            one, other = (
                spot[k][log.drive.valid[k]],
                spot[k + 5][log.drive.valid[k + 5]],
            )
            near = z[k][log.drive.valid[k], 0] < 30
            if np.hypot(*(poses[k + 5] - poses[k])[:2]) < 1 or not len(other):
                continue
            gap = np.linalg.norm(one[near, None] - other[None], axis=-1).min(1)
            again, of = again + np.sum(gap < 0.4), of + len(gap)
        assert of > 300
        return again / of

    # Measured .6 and .1: half the trees are hidden or spurious.
    assert met(mirrored=False) > 0.5
    assert met(mirrored=True) < 0.25


def test_mrclam_recording(data):
    log = read_mrclam(data / "slam" / "utias_mrclam9")
    durations_add_up(log)
    step, slot = np.nonzero(log.drive.valid)
    early = log.times[step] < 700  # motion capture loses the heading later
    step, slot = step[early], slot[early]
    assert set(log.drive.ids[step, slot]) <= set(range(15))
    seen = log.drive.detections[step, slot]
    towards = log.landmarks[log.drive.ids[step, slot]] - reference_at_looks(log)[step]
    good = np.isfinite(log.headings)
    turned = np.interp(
        log.times, log.reference[good, 0], np.unwrap(log.headings[good])
    )[step]
    off = seen[:, 1] + turned - np.arctan2(towards[:, 1], towards[:, 0])
    off = np.abs(np.angle(np.exp(1j * off)))
    assert np.median(off) < 0.03
    assert np.percentile(off, 90) < 0.08
    assert np.median(np.abs(seen[:, 0] - np.hypot(*towards.T))) < 0.12
