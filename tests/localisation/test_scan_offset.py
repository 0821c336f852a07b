"""Two ways to say how far off a scan was taken: where each is right, and where not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.localisation.scan_offset import (
    outline_centroid,
    picture_phases,
    picture_shift,
)
from fsmsm_jax.sensing.outline_image import outline_image

SIZE = 64


def disc(x, y):
    """Ranges of a room 3 m around, seen from (x, y) off its middle; exactly."""
    bearings = -np.pi + 2 * np.pi * np.arange(360) / 360
    c, s = np.cos(bearings), np.sin(bearings)
    along = x * c + y * s
    ranges = -along + np.sqrt(along**2 + 9 - x**2 - y**2)
    return jnp.asarray(ranges, jnp.float32), jnp.asarray(bearings, jnp.float32)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.7, -1.1), (-2.0, 1.0)])
def test_centroids_are_exact_in_a_convex_room(x, y):
    wanted = outline_centroid(*disc(x, y))
    here = outline_centroid(*disc(0.3, 0.4))
    # C_V − C_R leads from here to there; 360 chords of a circle lie within 0.1 mm of it.
    np.testing.assert_allclose(here - wanted, [x - 0.3, y - 0.4], atol=1e-3)


@jax.jit
def shift_between(r, s):
    draw = lambda ranges: picture_phases(outline_image(ranges, SIZE, 16.0))
    return picture_shift(draw(r), draw(s))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.7, -1.1), (-1.4, 1.0)])
def test_pictures_tell_the_same(x, y):
    shift, peak = shift_between(disc(x, y)[0], disc(0.3, 0.4)[0])
    pixel = 16.0 / SIZE
    # The border's fading spoils a perfect shift by some tenths of a pixel.
    np.testing.assert_allclose(shift * pixel, [x - 0.3, y - 0.4], atol=pixel / 2)
    assert 0.1 < float(peak) <= 1.0


def test_pictures_shift_by_whole_pixels_exactly():
    rng = np.random.default_rng(0)
    picture = np.zeros((SIZE, SIZE), np.float32)
    picture[20:40, 24:36] = rng.uniform(size=(20, 12))
    moved = np.roll(picture, (-5, 8), (0, 1))  # five up, eight to the right
    shift, peak = picture_shift(
        *map(picture_phases, map(jnp.asarray, (picture, moved)))
    )
    np.testing.assert_allclose(shift, [8, 5], atol=0.1)
    same, one = picture_shift(*[picture_phases(jnp.asarray(picture))] * 2)
    np.testing.assert_allclose(same, [0, 0], atol=1e-3)
    # The low-pass counts the frequencies that hold nothing, too: not quite 1.
    assert float(peak) < float(one) == pytest.approx(1, abs=0.02)
