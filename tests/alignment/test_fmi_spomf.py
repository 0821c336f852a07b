"""FMI-SPOMF against independent warps: scipy's and scikit-image's, and by numpy alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import affine_transform, gaussian_filter

from fsmsm_jax.alignment.fmi_spomf import (
    FmiConfig,
    fmi_spomf,
    image_spectra,
    register_images,
    rotation_and_scale,
)
from fsmsm_jax.alignment.images.log_polar import log_polar_spectrum
from fsmsm_jax.alignment.images.phase_correlation import (
    highest_peaks,
    low_pass,
    phase_spectrum,
    sub_pixel,
)
from fsmsm_jax.alignment.images.similarity_fit import fit_similarity
from fsmsm_jax.alignment.images.similarity_warp import bilinear, similarity_warp

SQUARE, OBLONG = (96, 96), (80, 112)
# Off every axis, an odd half-turn among them: [rad], scale, (x, y up) [pixels].
CASES = [(0.4, 1.1, (5.3, -3.6)), (-2.3, 0.85, (-4.2, 6.1)), (3.1, 1.2, (3.0, 7.5))]
register = jax.jit(fmi_spomf)
turn = jax.jit(rotation_and_scale)


@jax.jit
def filtered(r, s):
    """Phase correlation with a hill of width 1."""
    Q = jnp.conj(phase_spectrum(r)) * phase_spectrum(s)
    return jnp.fft.irfft2(Q * low_pass(*r.shape, 1.0).astype(r.dtype), r.shape)


def scenery(shape, seed=0):
    """Blobs of several sizes, larger than the window, without any symmetry."""
    noise = np.random.default_rng(seed).normal(size=(3, *(2 * n + 60 for n in shape)))
    layers = (
        gaussian_filter(z, w) * w for z, w in zip(noise, (1.5, 4, 10), strict=True)
    )
    return sum(layers)


def window(source, shape):
    """The middle of it."""
    start = [(big - n) // 2 for big, n in zip(source.shape, shape, strict=True)]
    return source[start[0] : start[0] + shape[0], start[1] : start[1] + shape[1]]


def seen(source, shape, rotation, scale, shift):
    """s with s(T(p)) = r(p), by scipy in its own (row, column), cubic splines.

    In rows and columns a counter-clockwise turn by ξ, y up, is the matrix below; scipy
    wants the way back, from places in s to places in the source.
    """
    c, s = np.cos(rotation), np.sin(rotation)
    forth = scale * np.array([[c, -s], [s, c]])
    back = np.linalg.inv(forth)
    middle_s = (np.array(shape) - 1) / 2 + [-shift[1], shift[0]]
    starts = [(big - n) // 2 for big, n in zip(source.shape, shape, strict=True)]
    middle = (np.array(shape) - 1) / 2 + starts
    return affine_transform(source, back, middle - back @ middle_s, shape)


def pair(shape, case, seed=0):
    source = scenery(shape, seed)
    return window(source, shape), seen(source, shape, *case)


def errors(found, case):
    """[deg, %, pixels]."""
    rotation, scale, shift = case
    turned = (np.asarray(found.rotation) - rotation + np.pi) % (2 * np.pi) - np.pi
    yield abs(np.rad2deg(turned))
    yield 100 * abs(float(found.scale) / scale - 1)
    if hasattr(found, "shift"):
        yield np.hypot(*(np.asarray(found.shift) - shift))


def floats(*images):
    return [jnp.asarray(image, float) for image in images]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_finds_the_similarity_that_scipy_made(case):
    found = register(*floats(*pair(SQUARE, case)))
    assert bool(found.converged)
    # A tenth of what is asked for: linear against cubic interpolation of smooth blobs.
    assert all(np.array(list(errors(found, case))) < [0.05, 0.1, 0.1])


def test_finds_those_of_oblong_images_by_vmap():
    r, s = zip(*(pair(OBLONG, case, k) for k, case in enumerate(CASES)), strict=True)
    found = jax.jit(jax.vmap(fmi_spomf))(*floats(np.stack(r), np.stack(s)))
    for k, case in enumerate(CASES):
        one = jax.tree.map(lambda v, k=k: v[k], found)
        assert all(np.array(list(errors(one, case))) < [0.05, 0.1, 0.1])
    assert bool(found.converged.all())


@pytest.mark.parametrize("case", CASES, ids=str)
def test_fourier_alone_finds_rotation_and_scale(case):
    r, s = pair(SQUARE, case)
    found = turn(*floats(r, s))
    # A third of a bin of 0.7° and of 2.7 %: parabolas on hills seldom miss by more,
    # and windows that show different things of a small image add as much again.
    assert all(np.array(list(errors(found, case))) < [0.5, 1.5])


def test_agrees_with_scikit_images_warp():
    transform = pytest.importorskip("skimage.transform")
    r = window(scenery(SQUARE, 3), SQUARE)
    rotation, scale, shift = case = (0.3, 1.1, (4.0, -6.0))
    # scikit-image counts x from the left, y downward: angles change their sign.
    middle = (np.array(SQUARE[::-1]) - 1) / 2
    forth = (
        transform.SimilarityTransform(translation=-middle)
        + transform.SimilarityTransform(scale=scale, rotation=-rotation)
        + transform.SimilarityTransform(translation=middle + [shift[0], -shift[1]])
    )
    s = transform.warp(r, forth.inverse, order=3, mode="constant")
    found = register(*floats(r, s))  # black borders, too
    assert all(np.array(list(errors(found, case))) < [0.1, 0.2, 0.2])
    assert bool(found.converged)


def test_a_quarter_turn_to_the_left_is_positive_and_exact():
    r = window(scenery(SQUARE, 5), SQUARE)
    found = register(*floats(r, np.rot90(r)))
    # Pixels are moved, not interpolated: what is left is float32.
    assert all(np.array(list(errors(found, (np.pi / 2, 1.0, (0, 0))))) < 1e-2)
    assert float(found.similarity) > 0.99  # the finest frequencies are void in blobs


def test_an_image_is_itself():
    r = window(scenery(SQUARE, 6), SQUARE) + 100.0
    found = register(*floats(r, r))
    assert all(np.array(list(errors(found, (0.0, 1.0, (0, 0))))) < 1e-3)
    assert float(found.similarity) > 0.99
    assert bool(found.converged)


def test_the_way_back_is_the_inverse():
    r, s = floats(*pair(SQUARE, CASES[0], 2))
    there, back = register(r, s), register(s, r)
    assert abs(float(there.rotation + back.rotation)) < 1e-3
    assert abs(float(there.scale * back.scale) - 1) < 1e-3
    c, d = np.cos(there.rotation), np.sin(there.rotation)
    home = there.scale * np.array([[c, -d], [d, c]]) @ np.asarray(back.shift)
    np.testing.assert_allclose(home, -there.shift, atol=0.1)


def test_exposure_and_units_do_not_matter():
    r, s = pair(SQUARE, CASES[1])
    plain = register(*floats(r, s))
    other = register(*floats(1e3 * r + 7e3, 0.02 * s - 5))
    # Rounding at an offset of seven thousand, contrast 1e3: 1e-6 of it.
    np.testing.assert_allclose(other.rotation, plain.rotation, atol=1e-3)
    np.testing.assert_allclose(other.shift, plain.shift, atol=1e-2)


@pytest.mark.parametrize("kind", ["unrelated", "mirrored", "noise", "constant", "both"])
def test_never_sure_where_nothing_is_common(kind):
    r, s = pair(SQUARE, CASES[0])
    other = {
        "unrelated": window(scenery(SQUARE, 99), SQUARE),
        "mirrored": s[:, ::-1],
        "noise": np.random.default_rng(1).normal(size=SQUARE),
        "constant": np.full(SQUARE, 0.1),
        "both": np.full(SQUARE, 0.1),
    }[kind]
    r = np.full(SQUARE, 1e4 / 3) if kind == "both" else r
    found = register(*floats(r, other))
    assert not bool(found.converged)
    assert 0 <= float(found.similarity) < 0.3
    assert all(bool(jnp.isfinite(v).all()) for v in found)
    assert 0 <= float(turn(*floats(r, other)).similarity) < 0.3


def test_one_reference_for_many_by_vmap():
    r, _ = pair(SQUARE, CASES[0])
    source = scenery(SQUARE)
    many = jnp.stack(floats(*(seen(source, SQUARE, *case) for case in CASES)))
    (r,) = floats(r)
    R = jax.jit(image_spectra)(r)
    together = jax.jit(jax.vmap(rotation_and_scale, (None, 0)))(R, many)
    for k, s in enumerate(many):
        alone = turn(r, s)
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[k], b, atol=1e-4)


def test_double_precision_finds_the_same():
    images = pair(SQUARE, CASES[0])
    single = register(*floats(*images))
    with jax.enable_x64(True):
        double = register_images(*images)
        assert all(v.dtype == jnp.float64 for v in double[:4])
    assert all(v.dtype == jnp.float32 for v in single[:4])
    np.testing.assert_allclose(single.shift, double.shift, atol=2e-3)
    np.testing.assert_allclose(single.rotation, double.rotation, atol=1e-4)


def test_bad_images_are_refused():
    good = scenery((10, 10))[:40, :40]
    for bad, message in (
        (np.zeros((40, 40, 3)), r"shape \(40, 40, 3\).*colours grey"),
        (good[:, :20], r"40 × 20.*at least 32"),
        (np.where(good > good.mean(), np.nan, good), "finite"),
        (good + 1j, "real"),
    ):
        with pytest.raises(ValueError, match=message):
            register_images(bad, good)
        with pytest.raises(ValueError, match=message):
            register_images(good, bad)
    with pytest.raises(ValueError, match=r"one size, got \(40, 40\) and \(40, 39\)"):
        register_images(good, good[:, :39])


@pytest.mark.parametrize(
    "wrong", [{"kept": 5}, {"steps": 0}, {"lowest": 0.4}, {"highest": 0.6}]
)
def test_senseless_configs_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        FmiConfig(**wrong)


def test_the_threshold_is_no_shape():
    traces = []

    @jax.jit
    def count(config):
        traces.append(1)
        return 2 * config.threshold

    assert [float(count(FmiConfig(threshold=w))) for w in (0.25, 0.5)] == [0.5, 1.0]
    assert len(traces) == 1


# The parts, one by one.


def test_bilinear_is_exact_on_planes_and_still_at_the_border():
    i, j = np.mgrid[:5, :7]
    (plane,) = floats(2.0 * i - 3.0 * j + 1)
    row, column = floats(np.array([0.3, 3.9, 4.0]), np.array([5.2, 0.0, 6.0]))
    between = jax.jit(bilinear)
    np.testing.assert_allclose(
        between(plane, row, column), 2 * row - 3 * column + 1, rtol=1e-5
    )
    far = between(plane, *floats(np.array([-3.0, 9.0]), np.array([2.0, 99.0])))
    np.testing.assert_allclose(far, [plane[0, 2], plane[4, 6]])


def test_a_warp_undoes_scipys():
    source, case = scenery(OBLONG, 8), CASES[0]
    r, s = window(source, OBLONG), seen(source, OBLONG, *case)
    rotation, scale, shift = floats(*(np.asarray(v) for v in case))
    w, inside = jax.jit(similarity_warp)(*floats(s), rotation, scale, shift)
    sure = np.asarray(inside) > 0
    assert 0.5 < sure.mean() < 1.0
    # Linear interpolation of blobs 1.5 pixels wide leaves some per cent of contrast.
    assert np.abs(np.asarray(w) - r)[sure].mean() < 0.03 * r.std()


def test_log_polar_is_the_spectrum_where_it_says():
    (image,) = floats(window(scenery(OBLONG, 9), OBLONG))
    n, m = OBLONG
    fade = lambda k: 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(k) + 0.5) / k)
    window_ = np.outer(fade(n), fade(m))
    z = np.asarray(image, float)
    z = window_ * (z - (window_ * z).sum() / window_.sum())
    x, y = np.arange(m), -np.arange(n)[:, None]
    angles, rho = -np.pi / 2 + np.pi * np.arange(12) / 12, np.geomspace(0.05, 0.3, 9)
    direct = [
        [
            np.sqrt(p)
            * abs((z * np.exp(-2j * np.pi * p * (x * np.cos(t) + y * np.sin(t)))).sum())
            for p in rho
        ]
        for t in angles
    ]
    picture = np.asarray(log_polar_spectrum(image, 12, 9, 0.05, 0.3))
    direct = direct - np.mean(direct)
    # Where nothing fades, up to the mean; linear interpolation between padded bins.
    middle = picture[:, 3:6] - direct[:, 3:6]
    assert np.abs(middle - middle.mean()).max() < 0.08 * np.abs(direct).max()


def test_a_shift_is_a_hill_of_height_one_between_pixels():
    r = window(scenery(SQUARE, 4), SQUARE)
    F = np.fft.fft2(r)
    f, g = np.fft.fftfreq(96)[:, None], np.fft.fftfreq(96)
    s = np.fft.ifft2(F * np.exp(-2j * np.pi * (7.3 * f - 4.6 * g))).real
    q = filtered(*floats(r, s))
    (i,), (j,) = highest_peaks(q, 1, 48)
    row, column = jax.jit(sub_pixel)(q, i, j)
    # Exact on a Gaussian hill; that the finest frequencies are void changes it a bit.
    assert abs(float(row) - 7.3) < 0.01
    assert abs(float(column) - (96 - 4.6)) < 0.01
    assert 0.8 < float(q[i, j]) <= 1.001
    assert float(filtered(*floats(r, r))[0, 0]) > 0.99


def test_peaks_come_highest_first_and_within_reach():
    q = np.zeros((6, 8))
    q[1, 1], q[3, 7], q[4, 4] = 2.0, 3.0, 9.0  # the last one is out of reach
    i, j = highest_peaks(*floats(q), 2, 2.0)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(3, 7), (1, 1)]


def test_the_fit_forgives_a_passer_by():
    r, s = pair(SQUARE, CASES[0])
    s[30:60, 20:50] = s.max()
    r, s = ((v - v.mean()) / v.std() for v in (r, s))
    rotation, scale, shift = CASES[0]
    start = floats(
        *(np.asarray(v) for v in (rotation + 0.03, scale * 0.98, np.add(shift, 1.5)))
    )
    found = jax.jit(fit_similarity, static_argnums=5)(*floats(r, s), *start, 8)
    assert abs(float(found[0]) - rotation) < 1e-3
    np.testing.assert_allclose(found[2], shift, atol=0.1)
