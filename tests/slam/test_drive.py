"""Dirty logs: what `tidied` makes of them, and what it refuses."""

import numpy as np
import pytest

from fsmsm_jax.slam import tidied

NAN, INF = np.nan, np.inf
CONTROLS = np.array(
    [[[3.0, 0.1, 0.2], [2.0, 0.2, 0.1]], [[1.0, 0.3, 0.2], [4.0, 0.4, 0.3]]]
)
SEEN = np.array([[[5.0, 0.3], [6.0, -0.4]], [[7.0, 0.5], [8.0, 1.0]]])


def test_clean_logs_are_left_alone():
    drive = tidied(CONTROLS, SEEN, ids=np.array([[0, 1], [2, -1]]))
    np.testing.assert_array_equal(drive.controls, CONTROLS)
    np.testing.assert_allclose(drive.detections, SEEN, rtol=1e-15)
    assert drive.valid.all()
    assert drive.ids.tolist() == [[0, 1], [2, -1]]
    assert tidied(CONTROLS, SEEN).ids.tolist() == [[-1, -1], [-1, -1]]


def test_an_unusable_control_repeats_the_one_before():
    controls = CONTROLS.copy()
    controls[0, 1, 1], controls[1, 0, 0] = NAN, INF
    found = tidied(controls, SEEN).controls
    np.testing.assert_array_equal(found[0, 1], [3.0, 0.1, 0.1])
    np.testing.assert_array_equal(found[1], [[3.0, 0.1, 0.2], [4.0, 0.4, 0.3]])
    controls[0, 0] = [NAN, 0.1, 0.2]
    np.testing.assert_array_equal(
        tidied(controls, SEEN).controls[0], [[0, 0, 0.2], [0, 0, 0.1]]
    )
    controls[1, 1, 2] = NAN
    assert tidied(controls, SEEN).controls[1, 1, 2] == 0
    np.testing.assert_array_equal(CONTROLS[0, 1], [2.0, 0.2, 0.1])


@pytest.mark.parametrize(
    "bad", [[0.0, 0.1], [-1.0, 0.1], [NAN, 0.1], [3.0, NAN], [INF, 0.0], [3.0, INF]]
)
def test_no_place_on_the_ground_is_no_detection(bad):
    seen = SEEN.copy()
    seen[1, 0] = bad
    drive = tidied(CONTROLS, seen)
    assert drive.valid.tolist() == [[True, True], [False, True]]
    assert np.isfinite(drive.detections).all()
    assert (drive.detections[..., 0] > 0).all()


def test_bearings_are_wrapped():
    seen = SEEN + np.array([0.0, 4 * np.pi])
    np.testing.assert_allclose(tidied(CONTROLS, seen).detections, SEEN, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((CONTROLS[0], SEEN), r"controls of shape \[steps, controls, 3\].*\(2, 3\)"),
        ((CONTROLS[..., :2], SEEN), r"controls of shape .*\(2, 2, 2\)"),
        ((CONTROLS, SEEN[..., :1]), r"detections of shape .*\(2, 2, 1\)"),
        ((CONTROLS, SEEN[0]), r"detections of shape .*\(2, 2\)"),
        ((CONTROLS, SEEN[:1]), r"as many steps .*\(1, 2, 2\)"),
        ((CONTROLS, SEEN, np.ones((2, 3), bool)), r"as many steps .*\(2, 3\)"),
        ((CONTROLS, SEEN, None, np.zeros((1, 2), int)), r"as many steps .*\(1, 2\)"),
        ((CONTROLS * [1, 1, -1], SEEN), "4 controls last less than zero seconds"),
        (
            (CONTROLS, SEEN, None, np.full((2, 2), -3)),
            "ids from 0, or -1 for unknown, got -3",
        ),
    ],
)
def test_what_fits_no_drive_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        tidied(*arguments)
