"""Logs on disk become arrays; `read_scans` is the only door most people need."""

from fsmsm_jax.io.landmarks import (
    LandmarkLog as LandmarkLog,
    read_landmark_log as read_landmark_log,
)
from fsmsm_jax.io.logs import ScanLog as ScanLog, read_scans as read_scans
from fsmsm_jax.io.tum import (
    TumWriter as TumWriter,
    read_tum as read_tum,
    write_tum as write_tum,
)
