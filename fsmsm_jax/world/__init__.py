"""What surrounds the robot: maps as pytrees that rays can be cast in."""

from fsmsm_jax.world.occupancy import OccupancyGrid as OccupancyGrid
from fsmsm_jax.world.polygons import PolygonMap as PolygonMap
from fsmsm_jax.world.ros_map import load_map as load_map, save_map as save_map
from fsmsm_jax.world import buildings as buildings
