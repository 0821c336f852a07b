"""Stages: what is timed is what the row says, and the scans are what they claim."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax.benchmark import (
    STAGES,
    Amounts,
    Metric,
    Scene,
    Stage,
    measure,
    random_poses,
    rays_from,
    simulated_scans,
)
from fsmsm_jax.benchmark.scaling import CURVES
from fsmsm_jax.sensing import raycast
from fsmsm_jax.world import OccupancyGrid

FEW = Amounts(poses=32, scans=2, particles=200)


@pytest.fixture(scope="module")
def scene():
    return Scene(FEW)


@pytest.fixture(scope="module")
def hall():
    """A bare hall away from the origin, and turned: 20 m by 10 m inside."""
    cells = np.full((100, 200), 0)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    return OccupancyGrid.from_cells(cells, 0.1, (30.0, -20.0, 0.5))


def test_told_as_time_or_as_rate():
    assert Stage(lambda: None, "ms").told(0.02) == 20.0
    assert Stage(lambda: None, "scans/s", 16).told(0.5) == 32.0


def test_three_rows_a_stage(scene):
    rows = list(measure(scene, ("raycast", "orientation"), repeats=3))
    assert [row.key for row in rows] == [
        f"{stage}/{what}"
        for stage in ("raycast", "orientation")
        for what in ("speed", "ratio", "first_call")
    ]
    speed, ratio, first = rows[:3]
    assert speed.unit == "Mrays/s"
    assert speed.direction == "higher"
    assert speed.spread[0] <= speed.value <= speed.spread[1]
    # Only times in units of the reference are held against a baseline.
    assert [row.rel_tol is not None for row in rows] == 2 * [False, True, False]
    assert ratio.direction == first.direction == "lower"
    # First call: compilation and all, so longer than the others.
    assert first.value > 360e-6 * FEW.poses / speed.value


def test_rays_from_casts_what_it_says(hall):
    ranges = rays_from(hall, 5, 8)()
    assert ranges.shape == (5, 8)
    poses = random_poses(hall, 5)
    bearings = jnp.linspace(-jnp.pi, jnp.pi, 8, endpoint=False)
    one = jax.jit(raycast)(hall, poses[3], bearings)
    np.testing.assert_allclose(ranges[3], one, rtol=1e-5)


def test_random_poses_are_free_clear_of_walls_and_the_same_every_time(hall):
    poses = random_poses(hall, 200, seed=3, clearance=1.0)
    assert bool(jnp.all(hall.contains(poses[:, :2])))
    # Clearance is that of the cell's centre: half its diagonal, 0.07 m, from any point.
    assert float(hall.distance_at(poses[:, :2]).min()) > 0.9
    np.testing.assert_array_equal(poses, random_poses(hall, 200, seed=3, clearance=1.0))
    assert float(jnp.ptp(poses[:, 2])) > 5.5  # all headings


def test_simulated_scans_are_of_their_poses(hall):
    scans, poses = simulated_scans(hall, 20, outliers=0.2)
    assert scans.ranges.shape == (20, 360)
    cast = lambda p: raycast(hall, p, scans.bearings[0], 30.0)
    exact = np.asarray(jax.jit(jax.vmap(cast))(poses))
    off = np.abs(np.asarray(scans.ranges) - exact)
    blocked = np.mean(off > 0.1)  # 5σ of the noise
    assert 0.1 < blocked < 0.25  # a fifth, less those blocked just before the wall
    assert np.median(off) < 0.03


def test_curves_answer_the_four_questions():
    assert list(CURVES) == ["area", "rays", "batch", "devices"]


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGES)
def test_every_stage_runs(scene, name):
    speed, *_ = measure(scene, (name,), repeats=1)
    assert isinstance(speed, Metric)
    assert speed.value > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rays", "devices"])
def test_curves_are_measured(scene, name):
    for curve in CURVES[name](scene):
        assert curve.picture == name
        assert len(curve.sizes) == len(curve.seconds)
        assert all(0 < low <= mid <= high for low, mid, high in curve.seconds)
