"""Where am I: the atlas of a map, the search through it, and a robot on its way."""

from fsmsm_jax.localisation.atlas import (
    AtlasConfig as AtlasConfig,
    ScanAtlas as ScanAtlas,
)
from fsmsm_jax.localisation.atlas_build import (
    build_atlas as build_atlas,
    memory_estimate as memory_estimate,
)
from fsmsm_jax.localisation.settle import (
    Localisation as Localisation,
    SearchConfig as SearchConfig,
)
from fsmsm_jax.localisation.search import (
    localise as localise,
    localise_batch as localise_batch,
)
from fsmsm_jax.localisation.stream import (
    Answer as Answer,
    Query as Query,
    localise_stream as localise_stream,
)
from fsmsm_jax.localisation.fleet import Fleet as Fleet
from fsmsm_jax.localisation.motion import OdometryModel as OdometryModel
from fsmsm_jax.localisation import tracker as tracker
from fsmsm_jax.localisation.tracker import TrackerConfig as TrackerConfig
from fsmsm_jax.localisation.follow import (
    Fix as Fix,
    FollowConfig as FollowConfig,
    Reading as Reading,
    follow as follow,
)
from fsmsm_jax.localisation.track import Track as Track, track as track
from fsmsm_jax.resampling import (
    Kld as Kld,
    residual_systematic as residual_systematic,
    systematic as systematic,
)
from fsmsm_jax.localisation.likelihood import (
    CaerLikelihood as CaerLikelihood,
    LikelihoodField as LikelihoodField,
)
from fsmsm_jax.localisation.feedback import (
    Feedback as Feedback,
    ScanMatching as ScanMatching,
    Selection as Selection,
)
from fsmsm_jax.localisation import particles as particles
from fsmsm_jax.localisation.particles import (
    ParticleConfig as ParticleConfig,
    ParticleInfo as ParticleInfo,
    Particles as Particles,
)
from fsmsm_jax.localisation.clouds import (
    init_at as init_at,
    init_from_atlas as init_from_atlas,
    init_uniform as init_uniform,
)
from fsmsm_jax.localisation.pgl_fmic import (
    PglFmic as PglFmic,
    PglFmicConfig as PglFmicConfig,
    pgl_fmic as pgl_fmic,
)
from fsmsm_jax.localisation import odometer as odometer
from fsmsm_jax.localisation.odometer import (
    LidarOdometryConfig as LidarOdometryConfig,
)
from fsmsm_jax.localisation.lidar_odometry import (
    LidarOdometry as LidarOdometry,
    lidar_odometry as lidar_odometry,
)
