"""What surrounds the robot: maps as pytrees that rays can be cast in."""

from fsmsm_jax.world.occupancy import OccupancyGrid as OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap as PolygonMap
