"""Likelihoods against loops over particles and rays, anywhere on a turned grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fsmsm_jax import Lidar, Scan, raycast
from fsmsm_jax.localisation.likelihood import (
    CaerLikelihood,
    LikelihoodField,
    log_likelihoods,
)
from tests.worlds import free_poses, l_room, random_grid


def seen(world, pose, rays=40, range_max=6.0):
    lidar = Lidar.create(rays, 4.5, range_max, noise=0.02, dropout=0.1)
    exact = raycast(world, jnp.asarray(pose, float), lidar.bearings, range_max)
    return lidar.measure(jax.random.key(0), exact)


def field_by_hand(grid, scan, pose, model):
    """One particle, ray by ray."""
    x0, y0, yaw = np.asarray(grid.origin, float)
    distance, resolution = np.asarray(grid.distance), float(grid.resolution)
    total = 0.0
    for r, b, echo in zip(
        *map(np.asarray, (scan.ranges, scan.bearings, scan.echo)), strict=True
    ):
        if not echo:
            continue
        x, y = (
            pose[0] + r * np.cos(pose[2] + b) - x0,
            pose[1] + r * np.sin(pose[2] + b) - y0,
        )
        column = int(np.floor((x * np.cos(yaw) + y * np.sin(yaw)) / resolution))
        row = int(np.floor((y * np.cos(yaw) - x * np.sin(yaw)) / resolution))
        inside = 0 <= row < distance.shape[0] and 0 <= column < distance.shape[1]
        d = distance[row, column] if inside else np.inf
        p = model.z_hit * np.exp(-(d**2) / (2 * model.sigma_hit**2))
        p += model.z_rand / float(scan.range_max)
        total += p**3 if model.rule == "sum_of_cubes" else np.log(p)
    return np.log(1 + total) if model.rule == "sum_of_cubes" else total


@pytest.mark.parametrize("rule", ["sum_of_cubes", "product"])
def test_field_is_the_sum_over_rays(rule):
    grid = random_grid(3)
    poses = free_poses(grid, 12)
    scan = seen(grid, poses[0])
    model = LikelihoodField(rays=int(scan.valid.sum()), rule=rule, sigma_hit=0.3)
    found = np.asarray(log_likelihoods(grid, scan, jnp.asarray(poses, float), model))
    expected = [field_by_hand(grid, scan, p, model) for p in poses]
    # A point on a cell's edge may fall into the next one in float32.
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.05)
    assert np.argmax(found) == 0


@pytest.mark.parametrize("world", [random_grid(5), l_room()], ids=["grid", "polygons"])
@pytest.mark.parametrize(
    "model", [LikelihoodField(), LikelihoodField(rule="product"), CaerLikelihood()]
)
def test_the_truth_is_likeliest(world, model):
    true = (
        free_poses(world, 1)[0]
        if hasattr(world, "cells")
        else np.array([12.5, -7.25, 2.9])
    )
    offs = np.array(
        [[0, 0, 0], [0.4, 0, 0], [0, -0.4, 0], [0, 0, 0.4], [3, 3, 0], [500, 0, 0]]
    )
    scan = seen(world, true)
    poses = jnp.asarray(true + offs, float)
    found = jax.jit(log_likelihoods)(world, scan, poses, model)
    assert np.isfinite(found).all()
    assert int(jnp.argmax(found)) == 0
    together = jax.vmap(log_likelihoods, (None, None, 0, None))(
        world, scan, poses[:, None], model
    )
    np.testing.assert_allclose(together[:, 0], found, rtol=1e-4, atol=1e-3)


def test_caer_per_ray_is_what_weighs():
    room, true = l_room(), jnp.asarray([12.5, -7.25, 2.9])
    scan = seen(room, true)
    pose = true + jnp.asarray([0.1, 0.05, 0.02])
    virtual = np.asarray(raycast(room, pose, scan.bearings, 6.0))
    off = np.minimum(np.abs(np.asarray(scan.ranges) - virtual), 0.5)
    expected = -off[np.asarray(scan.valid)].mean() / 0.05
    model = CaerLikelihood(rays=int(scan.valid.sum()))
    found = log_likelihoods(room, scan, pose[None], model)
    np.testing.assert_allclose(found, [expected], rtol=1e-3)


@pytest.mark.parametrize(
    "model", [LikelihoodField(), LikelihoodField(rule="product"), CaerLikelihood()]
)
def test_a_scan_without_information_prefers_nobody(model):
    scan = Scan(
        ranges=jnp.full(30, 6.0),
        bearings=jnp.linspace(-2, 2, 30),
        valid=jnp.zeros(30, bool),
        echo=jnp.zeros(30, bool),
        range_max=jnp.asarray(6.0),
    )
    poses = jnp.asarray(free_poses(random_grid(5), 9), float)
    found = np.asarray(log_likelihoods(random_grid(5), scan, poses, model))
    assert np.isfinite(found).all()
    assert np.ptp(found) == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: LikelihoodField(rays=0), "at least one ray"),
        (lambda: CaerLikelihood(rays=0), "at least one ray"),
        (lambda: LikelihoodField(rule="mean"), "rule must be"),
    ],
)
def test_unusable_settings(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
