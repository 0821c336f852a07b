"""How good is an answer: errors, success, and the best that physics allows.

The published experiments, in the order in which data passes through them: worlds out
of scans (`environments`), questions with their noise (`cases`), numbers with their
uncertainty (`estimates`), whole matchers (`experiments`) and their parts (`stages`).
And from how far off a matcher finds home (`basins`).
"""

from fsmsm_jax.evaluation.metrics import (
    cramer_rao_bound as cramer_rao_bound,
    pose_errors as pose_errors,
    position_rms as position_rms,
    nees as nees,
    success as success,
)
from fsmsm_jax.evaluation.environments import (
    Environments as Environments,
    close_half_scans as close_half_scans,
    simulated_half_scans as simulated_half_scans,
)
from fsmsm_jax.evaluation.cases import (
    DISPLACEMENTS as DISPLACEMENTS,
    FARTHEST as FARTHEST,
    Cases as Cases,
    draw_cases as draw_cases,
    noisy as noisy,
    published_cases as published_cases,
    scan_to_scan as scan_to_scan,
)
from fsmsm_jax.evaluation.estimates import (
    Estimate as Estimate,
    Spread as Spread,
    mean_of as mean_of,
    paired as paired,
    quantile_of as quantile_of,
    share_of as share_of,
    spread_of as spread_of,
)
from fsmsm_jax.evaluation.experiments import (
    Errors as Errors,
    Row as Row,
    degree_sweep as degree_sweep,
    match_errors as match_errors,
    match_row as match_row,
    match_table as match_table,
    range_limit_sweep as range_limit_sweep,
)
from fsmsm_jax.evaluation.stages import (
    caer_pairs as caer_pairs,
    heading_candidates as heading_candidates,
    rotation_row as rotation_row,
    translation_walk as translation_walk,
)
from fsmsm_jax.evaluation.basins import Basin as Basin, basin as basin
from fsmsm_jax.evaluation.ways import plan as plan
from fsmsm_jax.evaluation.drives import Drive as Drive, drive as drive, record as record
from fsmsm_jax.evaluation.slam import (
    consistency as consistency,
    map_error as map_error,
    moved as moved,
    onto as onto,
    way_error as way_error,
)
from fsmsm_jax.evaluation.drift import Drift as Drift, drift as drift, way as way
