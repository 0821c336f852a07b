"""What a lidar sees: sensors, virtual scans, and real ones brought into form."""

from fsmsm_jax.sensing.lidar import Lidar as Lidar, Scan as Scan
from fsmsm_jax.sensing.panorama import panorama as panorama
from fsmsm_jax.sensing.raycast import (
    raycast as raycast,
    raycast_with_jacobian as raycast_with_jacobian,
)
from fsmsm_jax.sensing.surfaces import Surfaces as Surfaces, surfaces as surfaces
from fsmsm_jax.sensing.outline import (
    closed_outline as closed_outline,
    seen_space as seen_space,
)
from fsmsm_jax.sensing.outline_image import outline_image as outline_image
from fsmsm_jax.sensing.sweep import moments as moments, unswept as unswept
