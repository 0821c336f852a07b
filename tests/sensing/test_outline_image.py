"""Pictures of outlines against distances to every edge, and what turning does to them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.sensing.outline_image import outline_image

RAYS = 120


def bearings(rays=RAYS):
    return -np.pi + 2 * np.pi * np.arange(rays) / rays


def jagged(seed, rays=RAYS):
    rng = np.random.default_rng(seed)
    return jnp.asarray(np.repeat(rng.uniform(1, 6, rays // 10), 10), jnp.float32)


def to_outline(ranges, size, extent):
    """Distance [pixels] of each pixel's middle to the nearest edge, by all of them."""
    r, b = np.asarray(ranges, float) * size / extent, bearings(len(ranges))
    start = np.column_stack([r * np.cos(b), r * np.sin(b)])
    edge = np.roll(start, -1, axis=0) - start
    middle = np.arange(size) - (size - 1) / 2
    x, y = np.meshgrid(middle, -middle)
    point = np.stack([x, y], axis=-1)[:, :, None] - start
    along = np.sum(point * edge, axis=-1) / np.sum(edge**2, axis=-1)
    point -= np.clip(along, 0, 1)[..., None] * edge
    return np.linalg.norm(point, axis=-1).min(axis=-1)


@pytest.mark.parametrize(("seed", "size", "extent"), [(0, 40, 14.0), (1, 41, 13.0)])
def test_ink_is_where_the_edges_are(seed, size, extent):
    ranges = jagged(seed)
    ink = np.asarray(outline_image(ranges, size, extent))
    away = to_outline(ranges, size, extent)
    assert ink.min() >= 0
    assert ink.max() <= 1
    # Corners of a pixel are 0.7 from its middle and the edge of the inside is a pixel
    # wide; seen along a slanted edge that is 0.7 + 0.5 at most.
    assert ink[away > 1.21].max() == 0
    # On a line ink is 0.7 to 1; acute corners and slits narrower than a pixel have less.
    on = ink[away < 0.3]
    assert np.mean(on > 0.4) > 0.9
    assert np.median(on) > 0.6


def test_a_wall_is_drawn_in_its_place():
    """A square of 4 m, 0.4 m a pixel: its walls lie 5 pixels from the middle."""
    b = bearings(720)
    square = 2 / np.maximum(np.abs(np.cos(b)), np.abs(np.sin(b)))
    ink = outline_image(jnp.asarray(square, jnp.float32), 15, 6.0)
    expected = np.zeros((15, 15))
    expected[[2, 12], 2:13] = expected[2:13, [2, 12]] = 1
    expected[[2, 2, 12, 12], [2, 12, 2, 12]] = np.sqrt(0.5)  # one of two diagonals
    np.testing.assert_allclose(ink, expected, atol=1e-4)


@pytest.mark.parametrize("size", [32, 33])
def test_a_turned_sensor_sees_a_turned_picture(size):
    """A wall a quarter further on, counter-clockwise: the picture by np.rot90."""
    ranges = jagged(3)
    ink = outline_image(ranges, size, 13.0)
    turned = outline_image(jnp.roll(ranges, RAYS // 4), size, 13.0)
    # Corners on an axis may fall to the next sector by rounding, along radial edges.
    close = np.isclose(turned, np.rot90(ink), atol=1e-3)
    assert close.mean() > 0.995


def test_up_is_up():
    """A room that reaches 5 m up and 1 m down, 4 m right and 2 m left."""
    b = bearings()
    c, s = np.cos(b), np.sin(b)
    ranges = 1 / np.max([c / 4, -c / 2, s / 5, -s], axis=0)
    ink = np.asarray(outline_image(jnp.asarray(ranges, jnp.float32), 48, 12.0))
    rows, columns = np.flatnonzero(ink.max(axis=1)), np.flatnonzero(ink.max(axis=0))
    np.testing.assert_allclose(23.5 - rows[[0, -1]], [20, -4], atol=1.01)
    np.testing.assert_allclose(columns[[0, -1]] - 23.5, [-8, 16], atol=1.01)


def test_metres_are_what_the_extent_says():
    ranges = jagged(4)
    small, large = (outline_image(k * ranges, 32, k * 13.0) for k in (1.0, 4.0))
    np.testing.assert_allclose(small, large, atol=1e-5)


def test_what_is_far_is_cut_off_and_what_is_near_is_finite():
    nothing = outline_image(jnp.full(RAYS, 9.0), 32, 12.0)
    assert float(nothing.max()) == 0
    at_the_sensor = outline_image(jnp.zeros(RAYS), 32, 12.0)
    assert np.isfinite(at_the_sensor).all()
    assert float(at_the_sensor[:14].max()) == 0


def test_jit_vmap_and_precision():
    ranges = jnp.stack([jagged(s) for s in range(3)])
    draw = lambda r: outline_image(r, 32, 13.0)
    together = jax.jit(jax.vmap(draw))(ranges)
    for one, r in zip(together, ranges, strict=True):
        np.testing.assert_allclose(one, draw(r), atol=1e-5)
    assert together.dtype == jnp.float32
    with jax.enable_x64(True):
        exact = draw(jnp.asarray(np.asarray(ranges[0], float)))
        assert exact.dtype == jnp.float64
        # float32 counts pixels to 1e-6; a radial edge may magnify that a little.
        np.testing.assert_allclose(together[0], exact, atol=1e-4)
