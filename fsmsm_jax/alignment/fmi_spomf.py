r"""FMI-SPOMF: by how much one image is turned, magnified and shifted against another.

Two images of one thing, taken from different sides and heights, differ by a similarity.
Search over its four numbers would be long, but Fourier takes them apart, two by two:

1. **turn and magnify** (Algorithm I): over (θ, log ρ) the magnitudes of the two spectra
   differ by a shift (`log_polar`), and phase correlation finds shifts
   (`phase_correlation`). The few highest peaks are kept;
2. **which half-turn, and where** (Algorithm II): for each peak, s is pulled back, as it
   is and on its head, and plain phase correlation with r gives the shift; the higher of
   the two peaks tells which way up. (The thesis says "Algorithm I" here as well, which
   would find rotation and scale once more; imreg_dft, its program, does as we do);
3. **fit**: Gauss-Newton on the pixels (`similarity_fit`), from where the Fourier
   transforms end;
4. **judge**: phase correlation of what both images show gives the similarity w.

The answer is the similarity T of `similarity_warp` that leads from r to s: what r shows
at p, from the centre, s shows at T(p) = σ R(ξ) p + t. x is to the right, *y up*, angles
counter-clockwise as seen with row 0 on top. So s is r, turned by +ξ about its centre,
σ times as large, then shifted by t, and `similarity_warp(s, ξ, σ, t)` looks like r.
The thesis's σ is 1 / σ. In rasters whose rows go *upward*, ξ and t_y change sign.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from fsmsm_jax import geometry
from fsmsm_jax.alignment.images.fmi_config import FmiConfig as FmiConfig
from fsmsm_jax.alignment.images.log_polar import apodised, fading, log_polar_spectrum
from fsmsm_jax.alignment.images.phase_correlation import (
    highest_peaks,
    low_pass,
    phase_spectrum,
    signed_shift,
    sub_pixel,
)
from fsmsm_jax.alignment.images.similarity_fit import fit_similarity
from fsmsm_jax.alignment.images.similarity_warp import similarity_warp

__all__ = [
    "FmiConfig",
    "ImageSpectra",
    "Registration",
    "RotationScale",
    "fmi_spomf",
    "image_spectra",
    "register_images",
    "rotation_and_scale",
]

_SMALLEST = 32  # [pixels] a side: fewer hold too few frequencies
_FADE = 0.5  # share of the sides that fades before shifts are sought
_HILL = 1.0  # [pixels] width of a peak over (x, y)
_TURN_HILL = 1.5  # [bins] width of a peak over (θ, log ρ)
_CONSTANT = 1e-5  # of the largest value: less contrast than this is rounding
_LEAST_OVERLAP = 0.1  # of the image


class Registration(NamedTuple):
    """Where in s the things in r are: at T(p) = σ R(ξ) p + t, from the centre."""

    rotation: Float[Array, "*batch"]
    """ξ [rad] in [−π, π), counter-clockwise as seen with row 0 on top."""
    scale: Float[Array, "*batch"]
    """σ: how many times larger things are in s."""
    shift: Float[Array, "*batch 2"]
    """t [pixels], (x to the right, y up): where in s the centre of r is, from s's."""
    similarity: Float[Array, "*batch"]
    """w in [0, 1]: the phase correlation, at this place, of what both show."""
    converged: Bool[Array, "*batch"]
    """Whether w says that the two are one thing; if not, believe none of the rest."""


class RotationScale(NamedTuple):
    """How s is turned and magnified against r, wherever it is."""

    rotation: Float[Array, "*batch"]
    """ξ [rad] in [−π, π), as in `Registration`."""
    scale: Float[Array, "*batch"]
    """σ, as in `Registration`."""
    similarity: Float[Array, "*batch"]
    """w in [0, 1]: the highest peak of the phase correlation, turned and rescaled."""


class ImageSpectra(NamedTuple):
    """An image as it is compared with others; made once for many comparisons."""

    plain: Complex[Array, "n bins"]
    """Phases of the image's spectrum, half of it."""
    log_polar: Complex[Array, "angles radial_bins"]
    """Phases of the spectrum of its log-polar magnitudes, half of it."""


def image_spectra(
    image: Float[Array, "n m"], config: FmiConfig = FmiConfig()
) -> ImageSpectra:
    """The phases that Algorithm I extracts from an image, and those of Algorithm II."""
    image = _standard(image)
    picture = log_polar_spectrum(
        image, config.angles, config.radii, config.lowest, config.highest
    )
    plain = phase_spectrum(apodised(image, _FADE))
    return ImageSpectra(plain, phase_spectrum(picture))


def rotation_and_scale(
    r: Float[Array, "n m"] | ImageSpectra,
    s: Float[Array, "n m"],
    config: FmiConfig = FmiConfig(candidates=1),
) -> RotationScale:
    """Rotation, scale and similarity of two images: steps 1 and 2, without the fit.

    Args:
        r: reference image, or `image_spectra(r, config)`, made once for many s.
        s: the other image, of the same size.
        config: settings, the same as for the spectra.

    Returns:
        What is left when the shift does not matter; `fmi_spomf` is finer.

    Example:
        >>> r = jnp.zeros((64, 64)).at[20:30, 10:50].set(1.0)
        >>> found = rotation_and_scale(image_spectra(r), jnp.rot90(r))
        >>> round(float(jnp.rad2deg(found.rotation)), 1), round(float(found.scale), 2)
        (90.0, 1.0)

    Note:
        Pure; `vmap(rotation_and_scale, (None, 0))` compares many with one.
    """
    R = r if isinstance(r, ImageSpectra) else image_spectra(r, config)
    rotations, scales, _, peaks = _candidates(R, _standard(s), config)
    best = jnp.argmax(peaks)
    w = jnp.clip(peaks[best], 0.0, 1.0)
    return RotationScale(rotations[best], scales[best], w)


def fmi_spomf(
    r: Float[Array, "n m"],
    s: Float[Array, "n m"],
    config: FmiConfig = FmiConfig(),
) -> Registration:
    """The similarity that leads from image r to image s (Algorithm II, and a fit).

    Args:
        r: reference image, any real values; only contrast counts.
        s: the other image, of the same size.
        config: settings.

    Returns:
        The similarity and what to think of it; finite for finite images.

    Reference:
        Q. Chen, M. Defrise, F. Deconinck, "Symmetric phase-only matched filtering of
        Fourier-Mellin transforms for image registration and recognition", IEEE TPAMI
        16(12), 1994; B. S. Reddy, B. N. Chatterji, IEEE TIP 5(8), 1996.

    Note:
        Pure, of fixed length, for `vmap` and `jit`; checks nothing, see
        `register_images`. Not differentiable (peaks).
    """
    r, s = _standard(r), _standard(s)
    rotations, scales, shifts, peaks = _candidates(image_spectra(r, config), s, config)
    _, best = jax.lax.top_k(peaks, config.kept)

    def finish(k):
        found = fit_similarity(r, s, rotations[k], scales[k], shifts[k], config.steps)
        return found, *_judge(r, s, *found)

    found, likeness, overlap = jax.vmap(finish)(best)
    k = jnp.argmax(likeness)
    rotation, scale, shift = (v[k] for v in found)
    w = jnp.clip(likeness[k], 0.0, 1.0)
    fair = (scale < config.largest_scale) & (scale * config.largest_scale > 1)
    converged = (w >= config.threshold) & (overlap[k] > _LEAST_OVERLAP) & fair
    return Registration(geometry.wrap(rotation), scale, shift, w, converged)


def register_images(
    r: np.ndarray | Array,
    s: np.ndarray | Array,
    config: FmiConfig = FmiConfig(),
) -> Registration:
    """By how much image s is turned, magnified and shifted against image r.

    Args:
        r: reference image, grey values (rows, columns) in any units.
        s: the other image, of the same size.
        config: settings.

    Returns:
        The similarity, arrays on the device. `converged` is False where the images
        have nothing in common, or nothing in them.

    Raises:
        ValueError: an image is not two-dimensional, smaller than 32 pixels a side, not
            of real, finite numbers, or the two differ in size.

    Note:
        Compiled once for each size of image.
    """
    r, s = (_checked(name, image) for name, image in (("r", r), ("s", s)))
    if r.shape != s.shape:
        raise ValueError(
            f"expected two images of one size, got {r.shape} and {s.shape}; "
            "crop or pad one of them"
        )
    return _register(jnp.asarray(r, float), jnp.asarray(s, float), config)


_register = jax.jit(fmi_spomf)


def _checked(name, image):
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(
            f"image {name} has shape {image.shape}, expected (rows, columns); "
            "make colours grey, and use vmap(fmi_spomf) for many"
        )
    if min(image.shape) < _SMALLEST:
        raise ValueError(
            f"image {name} is {image.shape[0]} × {image.shape[1]}, expected at least "
            f"{_SMALLEST} pixels a side"
        )
    if not (np.isrealobj(image) and np.isfinite(image.astype(float)).all()):
        raise ValueError(f"image {name} holds values that are not real, finite numbers")
    return image


def _standard(image):
    """Mean 0, contrast 1; an image without any becomes all zeros."""
    contrast = jnp.std(image)
    some = contrast > _CONSTANT * jnp.max(jnp.abs(image))
    return jnp.where(some, image - jnp.mean(image), 0) / jnp.where(some, contrast, 1)


def _candidates(R, s, config):
    """For the highest peaks over (θ, log ρ): rotation, scale, shift, peak of q."""
    rotations, scales = _turns(R, image_spectra(s, config), config)
    faded = apodised(s, _FADE)
    place = jax.vmap(lambda rotation, scale: _placed(R, faded, rotation, scale))
    rotations, shifts, peaks = place(rotations, scales)
    return rotations, scales, shifts, peaks


def _turns(R, S, config):
    """Algorithm I: rotations, up to π, and scales."""
    angles, radii = config.angles, config.radii
    weights = low_pass(angles, radii, _TURN_HILL)
    Q = jnp.conj(R.log_polar) * S.log_polar * weights.astype(R.log_polar.real.dtype)
    q = jnp.fft.irfft2(Q, (angles, radii))
    bin_ = np.log(config.highest / config.lowest) / (radii - 1)
    i, j = highest_peaks(q, config.candidates, np.log(config.largest_scale) / bin_)
    i, j = jax.vmap(sub_pixel, (None, 0, 0))(q, i, j)
    rotations = signed_shift(i, angles) * np.pi / angles
    return rotations, jnp.exp(-signed_shift(j, radii) * bin_)


def _placed(R, faded, rotation, scale):
    """Algorithm II: which way up and where; rotation, shift, height of the peak."""
    n, m = faded.shape
    still = jnp.zeros(2, faded.dtype)
    warped, inside = similarity_warp(faded, rotation, scale, still)
    W = phase_spectrum(warped * inside)
    # On its head about the centre: pixel k goes to n − 1 − k, which is conjugation and
    # a step by one.
    f, g = np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(m)[None]
    on_its_head = jnp.conj(W) * jnp.asarray(np.exp(2j * np.pi * (f + g)), W.dtype)
    weights = low_pass(n, m, _HILL).astype(faded.dtype)
    Q = jnp.conj(R.plain) * weights
    q = jnp.fft.irfft2(Q[None] * jnp.stack([W, on_its_head]), (n, m))

    best = jnp.argmax(q)
    half_turns, i, j = jnp.unravel_index(best, q.shape)
    row, column = sub_pixel(q[half_turns], i, j)
    rotation = geometry.wrap(rotation + np.pi * half_turns)
    # The pulled-back s, displaced by d, is r; s itself is displaced by σ R(ξ) d.
    d = jnp.stack([signed_shift(column, m), -signed_shift(row, n)])
    turn = jnp.zeros(3, d.dtype).at[2].set(rotation)
    return rotation, scale * geometry.transform_points(turn, d), q.ravel()[best]


def _judge(r, s, rotation, scale, shift):
    """Phase correlation of what both show there, and how much that is of r."""
    n, m = r.shape
    own = jnp.asarray(fading(n, m, _FADE), r.dtype)
    w, inside = similarity_warp(s, rotation, scale, shift)
    other, _ = similarity_warp(own, rotation, scale, shift)
    window = own * other * inside
    area = jnp.maximum(jnp.sum(window), 1e-6)
    fade = lambda image: window * (image - jnp.sum(window * image) / area)
    Q = jnp.conj(phase_spectrum(fade(r))) * phase_spectrum(fade(w))
    q = jnp.fft.irfft2(Q * low_pass(n, m, _HILL).astype(r.dtype), (n, m))
    return q[0, 0], area / jnp.sum(own)
