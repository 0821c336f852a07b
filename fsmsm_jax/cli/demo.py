"""`fsmsm demo`: lost and found in a building that does not exist."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from fsmsm_jax.cli.console import area, summary, timed
from fsmsm_jax.cli.localise import (
    draw_localisation,
    load_or_build_atlas,
    localise_twice,
    report,
)
from fsmsm_jax.geometry import between
from fsmsm_jax.sensing.lidar import Lidar
from fsmsm_jax.sensing.raycast import raycast
from fsmsm_jax.world.buildings import office
from fsmsm_jax.world.occupancy import OccupancyGrid

_CLEARANCE = 0.4  # [m] the demo's robot keeps from walls


def demo(seed: int = 0, picture: Path = Path("demo.png")) -> None:
    """Get lost in a made-up office building and be found again.

    The scan covers 270°, and a third of its rays end on people and boxes that are not
    on the map.

    Args:
        seed: which building, which place in it, and which noise.
        picture: where to write the picture.
    """
    world = office(seed)
    key_pose, key_scan = jax.random.split(jax.random.key(seed))
    truth = _random_pose(key_pose, world)
    lidar = Lidar.create(rays=360, field_of_view=1.5 * np.pi, noise=0.02, outliers=0.2)
    scan = lidar.measure(key_scan, raycast(world, truth, lidar.bearings))
    print(f"map       an office floor out of seed {seed}, {area(world):.0f} m² free")
    print(
        f"scan      {summary(scan)}, noise 2 cm, 20 % of the rays blocked", flush=True
    )
    scan_atlas, atlas_time = timed(lambda: load_or_build_atlas(world, 0.25, None))
    result, first, warm = localise_twice(scan_atlas, scan)
    print(report(result, {"atlas": atlas_time, "first_query": first, "query": warm}))
    x, y, theta = np.asarray(truth, float)
    error = np.asarray(between(truth, jnp.asarray(result.pose)), float)
    print(
        f"truth     x {x:.3f} m, y {y:.3f} m, heading {np.rad2deg(theta):.2f}°: off by "
        f"{1e3 * np.hypot(*error[:2]):.0f} mm and {abs(np.rad2deg(error[2])):.2f}°"
    )
    draw_localisation(picture, world, scan, result, truth)
    print(f"picture   {picture}")


def _random_pose(key: PRNGKeyArray, world: OccupancyGrid) -> Float[Array, "3"]:
    """A pose [m, m, rad] uniform over the free space that keeps clear of walls."""
    key_cell, key_heading = jax.random.split(key)
    cells = jnp.argwhere(world.free & (world.distance > _CLEARANCE))
    row, column = cells[jax.random.randint(key_cell, (), 0, len(cells))]
    position = world.to_map(jnp.stack([column, row]) + 0.5)
    heading = jax.random.uniform(key_heading, (1,), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.concatenate([position, heading])
