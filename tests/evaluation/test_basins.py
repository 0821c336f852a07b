from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.alignment import refine
from fsmsm_jax.evaluation import basin, pose_errors
from fsmsm_jax.sensing import Scan, raycast
from tests.worlds import CENTRE, square_room, star

BEARINGS = jnp.linspace(-jnp.pi, jnp.pi, 120, endpoint=False)
CASES = 16
TRUE = jnp.asarray([[*CENTRE, 0.3]], float) + jnp.linspace(0, 0.1, CASES)[:, None]


def cases(worlds):
    ranges = jax.jit(jax.vmap(raycast, (0, 0, None)))(worlds, TRUE, BEARINGS)
    seen = jnp.ones(120, bool)
    scan = lambda ranges: Scan(ranges, BEARINGS, seen, seen, jnp.asarray(30.0))
    return jax.vmap(scan)(ranges)


def stacked(*worlds):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)


ROOMS = stacked(*[square_room()] * CASES)


def test_initial_errors_are_as_asked_and_the_same_for_all_matchers():
    asked = []

    def never(worlds, scans, initial):
        asked.append(initial)
        return initial

    scans = cases(ROOMS)
    found = basin(jax.random.key(0), never, ROOMS, scans, TRUE, [0.0, 0.5], [0.01, 0.2])
    assert found.share.tolist() == [[1, 0], [0, 0]]
    assert found.asked.tolist() == [1, 1]
    for initial, (distance, turn) in zip(
        asked, [(0, 0.01), (0, 0.2), (0.5, 0.01), (0.5, 0.2)], strict=True
    ):
        metres, radians = pose_errors(initial, TRUE)
        np.testing.assert_allclose(metres, distance, atol=1e-5)
        np.testing.assert_allclose(radians, turn, atol=1e-5)
    first = asked.copy()
    basin(jax.random.key(0), never, ROOMS, scans, TRUE, [0.0, 0.5], [0.01, 0.2])
    np.testing.assert_array_equal(first, asked[4:])
    # Different directions and both sides.
    assert np.std(np.asarray(asked[3])[:, 0]) > 0.1
    assert len(np.unique(np.sign(np.asarray(asked[3] - TRUE)[:, 2]))) == 2


def test_starts_stay_in_the_open_or_are_not_asked():
    """A 4 m room: 2.3 m from its middle only its corners are left, 5 m away nothing."""
    inside = jax.vmap(lambda world, pose: world.contains(pose[:2]))
    free = []

    def note(worlds, scans, initial):
        free.append(np.asarray(inside(worlds, initial)))
        return TRUE

    found = basin(jax.random.key(1), note, ROOMS, cases(ROOMS), TRUE, [1.0, 2.3, 5.0], [0.1])  # fmt: skip
    assert free[0].all()
    assert found.asked[0] == 1
    assert found.asked[1] == pytest.approx(np.mean(free[1]))
    assert 0 < found.asked[1] <= 1
    assert found.asked[2] == 0
    assert found.share[:2].tolist() == [[1], [1]]
    assert np.isnan(found.share[2]).all()


def test_descent_comes_home_from_near_and_not_from_far():
    worlds = stacked(*[star(seed) for seed in range(CASES)])
    scans = cases(worlds)
    one = lambda world, scan, pose: refine(world, scan, pose).pose
    match = jax.jit(jax.vmap(one))
    found = basin(jax.random.key(2), match, worlds, scans, TRUE, [0.05, 0.9], [0.05, 1.5])  # fmt: skip
    assert found.share[0, 0] == 1
    assert found.share[1, 1] < 0.5


def test_picture_shows_the_shares_and_the_line_around_them():
    figure = import_module("matplotlib.figure")
    plotting = import_module("fsmsm_jax.plotting")
    ax = figure.Figure().add_subplot()
    share = np.array([[1.0, 0.99, 0.5], [0.97, 0.4, np.nan]])
    mesh, line = plotting.plot_basin(ax, np.array([0.1, 0.4]), np.radians([5.0, 20, 40]), share)  # fmt: skip
    np.testing.assert_allclose(mesh.get_array().compressed(), share[np.isfinite(share)])
    assert line is not None
    assert ax.get_xlim()[1] > 40  # degrees
    ax.figure.savefig(import_module("io").BytesIO())
    _, none = plotting.plot_basin(ax, np.array([0.1, 0.4]), np.radians([5.0, 20]), np.ones((2, 2)))  # fmt: skip
    assert none is None
