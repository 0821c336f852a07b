"""Section `images`: FMI-SPOMF on similarities of public test images, beside imreg_dft
and scikit-image on the same pairs.

A pair is made from one larger source. r is a window of it, upright and at the source's
own scale, at a random place. s is another window of the same size: the source seen
through the similarity, by cubic splines. Windows are so small against their sources
that nothing outside the source is ever asked for: both show true content up to
their borders, and s shows things that r does not. With *black borders*, s is made from
r alone, and what r does not show is black.
"""

import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import cbook, image as mpl_image
from scipy.ndimage import map_coordinates
from thesis.report import Table, interval, number, percent

from fsmsm_jax.alignment.fmi_spomf import fmi_spomf
from fsmsm_jax.alignment.images.similarity_warp import pixel_places
from fsmsm_jax.evaluation import quantile_of, share_of

NAMES = (
    *("camera", "coins", "moon", "brick", "grass", "gravel", "page", "text"),
    *("astronaut", "coffee", "chelsea", "rocket", "immunohistochemistry"),
    *("hubble_deep_field", "retina", "cell", "clock"),
)
SCALES, SHIFT = (0.8, 1.25), 0.1  # log-uniform; of the side, in x and in y
REACH = 1.065  # sides from the centre of r to the farthest pixel that s may show
SIDES = (224, 128, 80)  # of windows: the largest for which a source is large enough
WITHIN = (0.5, 1.0, 1.0)  # [deg, %, pixels]
BATCH = 16
CLEAN, BORDERS = "true content", "black borders"


class Pair(NamedTuple):
    name: str
    r: np.ndarray
    s: np.ndarray
    truth: np.ndarray
    """Rotation [rad], scale, shift x, shift y [pixels]."""


@cache
def sources() -> dict[str, np.ndarray]:
    """Grey images in [0, 1], none of which is downloaded."""
    try:
        from skimage import data
    except ImportError as error:
        raise SystemExit("this section needs `pip install scikit-image`") from error
    images = {name: getattr(data, name)() for name in NAMES}
    portrait: Any = cbook.get_sample_data("grace_hopper.jpg")
    with portrait as file:
        images["grace_hopper"] = mpl_image.imread(file, format="jpg")
    terrain: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    with terrain as file:
        images["jacksboro"] = file["elevation"]
    return {name: _grey(image) for name, image in images.items()}


def _grey(image):
    image = np.asarray(image, float)
    if image.ndim == 3:
        image = image[..., :3] @ [0.2125, 0.7154, 0.0721]
    image = image - image.min()
    return image / image.max()


def pairs(count: int, seed: int, kind: str = CLEAN) -> list[Pair]:
    rng = np.random.default_rng(seed)
    images = list(sources().items())
    return [_pair(*images[k % len(images)], kind, rng) for k in range(count)]


def _pair(name, source, kind, rng):
    side = next(d for d in SIDES if 2 * REACH * d < min(source.shape))
    centre = np.array(
        [rng.uniform(REACH * side, n - 1 - REACH * side) for n in source.shape]
    )
    rotation = rng.uniform(-np.pi, np.pi)
    scale = np.exp(rng.uniform(*np.log(SCALES)))
    x0, y0 = shift = rng.uniform(-SHIFT, SHIFT, 2) * side
    x, y = pixel_places(side, side)
    r = map_coordinates(source, [centre[0] - y, centre[1] + x])
    c, d = np.cos(rotation) / scale, np.sin(rotation) / scale
    back_x, back_y = c * (x - x0) + d * (y - y0), c * (y - y0) - d * (x - x0)
    if kind == BORDERS:
        middle = (side - 1) / 2
        s = map_coordinates(r, [middle - back_y, middle + back_x], mode="constant")
    else:
        s = map_coordinates(source, [centre[0] - back_y, centre[1] + back_x])
    return Pair(name, r, s, np.array([rotation, scale, *shift]))


def noisy(given: list[Pair], share: float, seed: int) -> list[Pair]:
    """Both with noise, in shares of their contrast, and s in another exposure."""
    rng = np.random.default_rng(seed)
    draw = lambda image: image + rng.normal(0, share * image.std(), image.shape)
    return [p._replace(r=draw(p.r), s=1.5 * draw(p.s) - 0.3) for p in given]


def mirrored(given: list[Pair]) -> list[Pair]:
    return [p._replace(s=p.s[:, ::-1].copy()) for p in given]


def unrelated(given: list[Pair], seed: int) -> list[Pair]:
    """Each r with the s of another source, of the same size."""
    rng = np.random.default_rng(seed)

    def other(pair):
        fit = [p.s for p in given if p.name != pair.name and p.s.shape == pair.s.shape]
        return fit[rng.integers(len(fit))]

    return [p._replace(s=other(p)) for p in given]


_one = jax.jit(fmi_spomf)
_many = jax.jit(jax.vmap(fmi_spomf))


def ours(r: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, float, bool]:
    """Rotation, scale, shift; similarity; converged."""
    found = _one(jnp.asarray(r, float), jnp.asarray(s, float))
    answer = np.array([found.rotation, found.scale, *found.shift])
    return answer, float(found.similarity), bool(found.converged)


def by_imreg(r: np.ndarray, s: np.ndarray) -> np.ndarray:
    """imreg_dft, three rounds: it moves its second image onto its first."""
    imreg_dft: Any = import_module("imreg_dft")

    try:
        found: Any = imreg_dft.similarity(s, r, numiter=3)
    except ValueError:  # what it calls "scale change too big to be true"
        return np.full(4, np.nan)
    down, right = np.asarray(found["tvec"])
    return np.array([np.deg2rad(found["angle"]), found["scale"], right, -down])


def by_skimage(r: np.ndarray, s: np.ndarray) -> np.ndarray:
    """scikit-image's gallery recipe, for smaller images: rotation, up to π, and scale."""
    from skimage.filters import difference_of_gaussians, window
    from skimage.registration import phase_cross_correlation
    from skimage.transform import warp_polar

    def picture(image):
        image = difference_of_gaussians(image, 1, 4) * window("hann", image.shape)
        magnitude = np.abs(np.fft.fftshift(np.fft.fft2(image)))
        polar = warp_polar(
            magnitude, radius=radius, output_shape=r.shape, scaling="log"
        )
        return polar[: len(r) // 2]

    radius = len(r) // 4
    correlate: Any = phase_cross_correlation  # None is allowed, whatever its types say
    (turned, magnified), *_ = correlate(
        picture(r), picture(s), upsample_factor=10, normalization=None
    )
    scale = np.exp(magnified * np.log(radius) / r.shape[1])
    return np.array([turned * 2 * np.pi / len(r), scale, np.nan, np.nan])


def errors(answers: np.ndarray, truth: np.ndarray, turn: float) -> np.ndarray:
    """[deg, %, pixels], infinite where there is no answer; rotations modulo `turn`."""
    rotation = np.abs((answers[:, 0] - truth[:, 0] + turn / 2) % turn - turn / 2)
    scale = np.abs(answers[:, 1] / truth[:, 1] - 1)
    shift = np.hypot(*(answers[:, 2:] - truth[:, 2:]).T)
    stacked = np.stack([np.rad2deg(rotation), 100 * scale, shift], axis=1)
    return np.where(np.isnan(stacked), np.inf, stacked)


def timed(method: Callable, given: list[Pair]) -> tuple[list, float]:
    """Answers, and the median time of one pair [ms]; what is compiled is not counted."""
    for shape in {p.r.shape for p in given}:
        first = next(p for p in given if p.r.shape == shape)
        method(first.r, first.s)
    answers, times = [], []
    for p in given:
        start = time.perf_counter()
        answers.append(method(p.r, p.s))
        times.append(time.perf_counter() - start)
    return answers, 1e3 * float(np.median(times))


def _row(kind, label, answers, given, ms, turn=2 * np.pi):
    found = errors(np.stack(answers), np.stack([p.truth for p in given]), turn)
    right = found < np.array(WITHIN)
    no_shift = not np.isfinite(found[:, 2]).any()
    together = right[:, :2] if no_shift else right
    medians = " / ".join(
        number(v) for v in np.median(found, axis=0)[: 2 if no_shift else 3]
    )
    return (
        *(
            kind,
            label,
            str(len(given)),
            percent(share_of(np.asarray(together.all(axis=1)))),
        ),
        *(f"{100 * share:.1f}" for share in right[:, :2].mean(axis=0)),
        "" if no_shift else f"{100 * right[:, 2].mean():.1f}",
        *(medians, number(ms)),
    )


def tables(options: Any) -> Iterator[Table]:
    """How often right, how alike, how fast."""
    count, theirs = (19, 4) if options.quick else (500, 150)
    kinds = {
        CLEAN: pairs(count, 0),
        BORDERS: pairs(count, 1, BORDERS),
        "noise 10 %": noisy(pairs(count, 2), 0.1, 12),
        "noise 30 %": noisy(pairs(count, 3), 0.3, 13),
    }
    rows, judged = [], {}
    for kind, given in kinds.items():
        answers, ms = timed(ours, given)
        found = [a[0] for a in answers]
        truth = np.stack([p.truth for p in given])
        right = (errors(np.stack(found), truth, 2 * np.pi) < WITHIN).all(axis=1)
        judged[kind] = answers, right
        rows.append(_row(kind, "ours", found, given, ms))
        if kind in (CLEAN, BORDERS):
            rows += list(_rivals(kind, given[:theirs]))
    yield Table(
        "Within 0.5°, 1 % and 1 pixel of the truth [%]",
        ("s shows", "method", "pairs", "all three", "rotation", "scale", "shift")
        + ("median errors [° / % / pixels]", "ms a pair"),
        rows,
        f"{len(sources())} public images, windows of 224, 128 or 80 pixels a side, any "
        "rotation, scale 0.8 to 1.25, shifts to 10 % of the side in x and in y. Noise is "
        "in shares of the contrast, in both images, and s in another exposure. imreg_dft "
        "with numiter=3; scikit-image's gallery recipe knows rotations up to π only "
        "(which counts as right here) and no shift.",
    )

    nothing = np.zeros(count, bool)
    base = pairs(count, 4)
    for kind, given in (
        ("mirrored", mirrored(base)),
        ("unrelated", unrelated(base, 14)),
    ):
        judged[kind] = [ours(p.r, p.s) for p in given], nothing
    rows = []
    for kind, (answers, right) in judged.items():
        w = np.array([a[1] for a in answers])
        sure = np.array([a[2] for a in answers])
        places = np.quantile(w, [0, 0.01, 0.05, 0.5, 0.95, 0.99, 1])
        rows.append(
            (kind, *(f"{v:.2f}" for v in places))
            + (percent(share_of(sure)), percent(share_of(sure & ~right)))
        )
    yield Table(
        "Similarity w, and what counts as converged [%]",
        ("s shows", "least", "1 %", "5 %", "median", "95 %", "99 %", "most")
        + ("converged", "converged and wrong"),
        rows,
        f"{count} pairs each. Mirrored: s as above, then left and right exchanged; "
        "some sources (coins, the rocket) are nearly symmetric.",
    )
    yield _batches(kinds[CLEAN])


def _rivals(kind, given):
    for label, method, turn in (
        ("imreg_dft", by_imreg, 2 * np.pi),
        ("scikit-image", by_skimage, np.pi),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # imreg_dft is older than its scipy
            try:
                answers, ms = timed(method, given)
            except ImportError:
                continue
        yield _row(kind, label, answers, given, ms, turn)


def _batches(given):
    """One at a time, and sixteen in one call."""
    rows = []
    for side in SIDES:
        some = [p for p in given if len(p.r) == side][:BATCH]
        some = (some * BATCH)[:BATCH]
        r, s = (
            jnp.asarray(np.stack(v), float)
            for v in zip(*(p[1:3] for p in some), strict=True)
        )
        alone = _clock(_one, r[0], s[0])
        together = _clock(_many, r, s)
        rows.append(
            (f"{side} × {side}", interval(alone), interval(together, 1 / BATCH))
        )
    return Table(
        "Time a pair [ms]",
        ("size", "alone", f"in a batch of {BATCH}"),
        rows,
        "Medians of 20 calls, compiled before, and their 95 % intervals.",
    )


def _clock(program, *images):
    """Time of one call [ms]."""
    times = []
    for _ in range(21):
        start = time.perf_counter()
        jax.block_until_ready(program(*images))
        times.append(1e3 * (time.perf_counter() - start))
    return quantile_of(np.array(times[1:]))
