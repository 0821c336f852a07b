"""How good is an answer: errors, success, and the best that physics allows."""

from fsmsm_jax.evaluation.metrics import (
    cramer_rao_bound as cramer_rao_bound,
    pose_errors as pose_errors,
    position_rms as position_rms,
    success as success,
)
