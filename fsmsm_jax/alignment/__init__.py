"""One scan against another: which way to turn, where to step, how well they agree."""

from fsmsm_jax.alignment.spectrum import (
    Spectrum as Spectrum,
    masked_squared_difference as masked_squared_difference,
    squared_difference as squared_difference,
)
from fsmsm_jax.alignment.orientation import (
    METHODS as METHODS,
    Orientation as Orientation,
    first_principles as first_principles,
    fourier_mellin as fourier_mellin,
    fourier_mellin_masked as fourier_mellin_masked,
    heading_costs as heading_costs,
    percent_discrimination as percent_discrimination,
    procrustes as procrustes,
    procrustes_trace as procrustes_trace,
    turned as turned,
)
from fsmsm_jax.alignment.theseus import (
    Candidates as Candidates,
    distinct_headings as distinct_headings,
    sinis as sinis,
    theseus as theseus,
)
from fsmsm_jax.alignment.position import (
    Translation as Translation,
    masked_position_correction as masked_position_correction,
    position_correction as position_correction,
    translate as translate,
)
from fsmsm_jax.alignment.kernels import (
    Absolute as Absolute,
    BeamModel as BeamModel,
    GemanMcClure as GemanMcClure,
    Kernel as Kernel,
    PseudoHuber as PseudoHuber,
    Truncated as Truncated,
)
from fsmsm_jax.alignment.caer import (
    caer as caer,
    caer_at as caer_at,
    caer_per_ray as caer_per_ray,
    truncated_caer_per_ray as truncated_caer_per_ray,
)
from fsmsm_jax.alignment.refine import Refined as Refined, refine as refine
from fsmsm_jax.alignment.fit import (
    descend_end_points as descend_end_points,
    fit_ranges as fit_ranges,
    polish_ranges as polish_ranges,
)
from fsmsm_jax.alignment.information import (
    Directions as Directions,
    covariance as covariance,
    covariance_root as covariance_root,
    cramer_rao_bound as cramer_rao_bound,
    degenerate_directions as degenerate_directions,
    fisher_information as fisher_information,
)
from fsmsm_jax.alignment.ros_pose import from_ros as from_ros, to_ros as to_ros
from fsmsm_jax.alignment.fsmsm_config import (
    Alignment as Alignment,
    FsmsmConfig as FsmsmConfig,
)
from fsmsm_jax.alignment.fsmsm import fsmsm as fsmsm
from fsmsm_jax.alignment.fast import (
    FastConfig as FastConfig,
    approach as approach,
    fast_match as fast_match,
)
from fsmsm_jax.alignment.match import (
    Match as Match,
    match as match,
    match_batch as match_batch,
)
from fsmsm_jax.alignment.views import (
    View as View,
    fit_views as fit_views,
    view_covariance as view_covariance,
    view_residuals as view_residuals,
)
from fsmsm_jax.alignment.fsm import (
    fast_fsm as fast_fsm,
    fsm as fsm,
    match_scans as match_scans,
    match_scans_batch as match_scans_batch,
)
from fsmsm_jax.alignment.fmi_spomf import (
    FmiConfig as FmiConfig,
    Registration as Registration,
    fmi_spomf as fmi_spomf,
    register_images as register_images,
    rotation_and_scale as rotation_and_scale,
)
