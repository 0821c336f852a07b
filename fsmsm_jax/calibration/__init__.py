"""What all scans have in common and nobody has measured: mounting, map, ranges."""

from fsmsm_jax.calibration.mounting import (
    Mounting as Mounting,
    MountingConfig as MountingConfig,
    mounting as mounting,
)
from fsmsm_jax.calibration.map_frame import (
    MapFrame as MapFrame,
    corrected as corrected,
    map_frame as map_frame,
)
from fsmsm_jax.calibration.ranges import (
    Noise as Noise,
    RangeCorrection as RangeCorrection,
    noise as noise,
    range_correction as range_correction,
)
