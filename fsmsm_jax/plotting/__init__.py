"""Pictures: each function draws one thing on an Axes that you bring, and returns it.

`world` draws the map, and `localisation` one answer on it; `scans` the space that one
scan saw; `thesis` what many answers are worth: the figures of the published evaluation,
with the published numbers on them; `basins` from how far off a matcher still finds
home; `tracking` the way of a robot, `odometry` the way that scans alone tell,
`slam` a map of landmarks.

Import this package by its name; `import fsmsm_jax` alone does not load matplotlib.
"""

from fsmsm_jax.plotting.colours import (
    POSE as POSE,
    RIVAL as RIVAL,
    SCAN as SCAN,
    TRUTH as TRUTH,
    UNKNOWN as UNKNOWN,
    WALL as WALL,
)
from fsmsm_jax.plotting.localisation import (
    plot_covariance as plot_covariance,
    plot_localisation as plot_localisation,
    plot_pose as plot_pose,
    plot_scan as plot_scan,
)
from fsmsm_jax.plotting.scans import (
    SeenSpaceArtists as SeenSpaceArtists,
    plot_seen_space as plot_seen_space,
)
from fsmsm_jax.plotting.thesis import (
    plot_caer as plot_caer,
    plot_convergence as plot_convergence,
    plot_errors as plot_errors,
    plot_path as plot_path,
    plot_similarity as plot_similarity,
    plot_sweep as plot_sweep,
)
from fsmsm_jax.plotting.basins import plot_basin as plot_basin
from fsmsm_jax.plotting.tracking import (
    plot_error_over_time as plot_error_over_time,
    plot_particles as plot_particles,
    plot_track as plot_track,
)
from fsmsm_jax.plotting.odometry import plot_odometry as plot_odometry
from fsmsm_jax.plotting.slam import (
    SLAM_COLOURS as SLAM_COLOURS,
    plot_particle_errors as plot_particle_errors,
    plot_run_times as plot_run_times,
    plot_slam as plot_slam,
)
from fsmsm_jax.plotting.benchmark import plot_scaling as plot_scaling
from fsmsm_jax.plotting.world import plot_world as plot_world
