import numpy as np
import pytest

from fsmsm_jax.evaluation.drift import LENGTHS, drift, way

RNG = np.random.default_rng(3)


def composed(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    turned = [c * b[0] - s * b[1], s * b[0] + c * b[1]]
    return np.array([a[0] + turned[0], a[1] + turned[1], a[2] + b[2]])


def inverse(a):
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def chain(motions, start=(40.0, -70.0, 2.0)):
    """Poses, far from the origin and turned."""
    poses = [np.array(start)]
    for motion in motions:
        poses.append(composed(poses[-1], motion))
    return np.array(poses)


def wander(scans=160):
    """A way in arcs, with stops, as motions."""
    motions = np.zeros((scans, 3))
    motions[:, 0] = 0.2 * (np.arange(scans) % 20 < 15)
    motions[:, 2] = 0.1 * np.sin(np.arange(scans) / 7)
    return motions


def test_nothing_is_lost_by_another_frame():
    true = chain(wander())
    moved = np.array([composed([3.0, 90.0, -2.5], pose) for pose in true])
    found = drift(moved, true)
    assert set(found.wanted) == set(LENGTHS)
    # Float64 at a hundred metres.
    assert found.translation.max() < 1e-12
    assert found.rotation.max() < 1e-12


def test_a_wheel_too_large_and_a_gyro_that_drifts():
    motions = wander()
    true = chain(motions)
    larger = drift(chain(motions * [1.03, 1.0, 1.0], (0, 0, 0)), true)
    # The way in between the ends of an arc is a little longer than their distance.
    assert 0.025 < larger.mean(1.0)[0] < 0.031
    assert larger.mean()[1] < 1e-12
    turning = motions + np.array([0.0, 0.0, 0.01]) * motions[:, :1]  # 0.01 rad a metre
    bent = drift(chain(turning, (5.0, 5.0, 1.0)), true)
    np.testing.assert_allclose(bent.mean()[1], 0.01, rtol=0.02)
    # On a straight way, a bend of κ leads astray by κℓ²/2 after ℓ, less for its first
    # step of 20, which is made before any turn.
    straight = np.tile([0.25, 0.0, 0.0], (80, 1))
    bent = drift(chain(straight + [0.0, 0.0, 0.0025]), chain(straight))
    np.testing.assert_allclose(bent.mean(5.0)[0], 0.01 * 5 / 2 * 19 / 20, rtol=0.01)


def test_as_brute_force_says_with_sparse_references():
    motions = wander(120)
    true = chain(motions)
    noisy = chain(motions + RNG.normal(0, [0.01, 0.01, 0.02], motions.shape), (9, 9, 3))
    reference = np.where(np.arange(len(true))[:, None] % 3 == 0, true, np.nan)
    noisy[30] = np.nan
    found = drift(noisy, reference, (2.0,))

    rows = [n for n in range(0, len(true), 3) if n != 30]
    along = way(true[rows])
    metres, radians, ends = [], [], []
    for a, i in enumerate(rows):
        later = [b for b in range(a, len(rows)) if along[b] >= along[a] + 2.0 - 1e-9]
        if not later or along[later[0]] - along[a] > 3.0:
            continue
        j, length = rows[later[0]], along[later[0]] - along[a]
        should = composed(inverse(true[i]), true[j])
        did = composed(inverse(noisy[i]), noisy[j])
        off = composed(inverse(should), did)
        metres.append(np.hypot(off[0], off[1]) / length)
        radians.append(abs(np.angle(np.exp(1j * off[2]))) / length)
        ends.append((i, j))
    np.testing.assert_array_equal(np.stack([found.start, found.end], 1), ends)
    np.testing.assert_allclose(found.translation, metres, atol=1e-12)
    np.testing.assert_allclose(found.rotation, radians, atol=1e-12)
    assert found.worst() == pytest.approx((max(metres), max(radians)))
    assert found.mean() == pytest.approx((np.mean(metres), np.mean(radians)))


def test_each_length_counts_alike_in_the_mean():
    true = chain(wander())
    found = drift(true + [0.02, 0, 0] * RNG.normal(size=(len(true), 1)), true)
    each = [found.mean(length) for length in LENGTHS]
    assert found.mean() == pytest.approx(tuple(np.mean(each, axis=0)))


def test_standing_still_is_no_way():
    still = np.array([7.0, 8.0, 1.0]) + RNG.normal(0, 0.01, (500, 3))
    assert way(still)[-1] == 0.0
    found = drift(still, still)
    assert not len(found.length)
    assert np.isnan(found.mean()).all()
    assert np.isnan(found.worst()).all()
    straight = np.stack([np.linspace(3, 13, 400), np.full(400, -5.0), np.ones(400)], 1)
    # Legs end at the first pose 0.1 m on, the last one is not complete.
    assert way(straight)[-1] == pytest.approx(10.0, abs=0.125)


def test_a_gap_in_the_reference_makes_no_sub_path():
    true = chain(np.tile([0.5, 0.0, 0.0], (40, 1)))
    reference = true.copy()
    reference[10:30] = np.nan
    found = drift(true, reference, (2.0,))
    assert len(found.length)
    assert found.length.max() <= 3.0
    assert not np.any((found.start < 10) & (found.end >= 30))


@pytest.mark.parametrize(
    ("poses", "lengths", "message"),
    [
        (np.zeros((4, 3)), (1.0,), r"\(4, 3\) and \(5, 3\)"),
        (np.zeros((5, 3)), (1.0, 0.0), "positive"),
        (np.zeros((5, 3)), (), "positive"),
    ],
)
def test_wrong_questions(poses, lengths, message):
    with pytest.raises(ValueError, match=message):
        drift(poses, np.zeros((5, 3)), lengths)
