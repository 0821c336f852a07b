"""Where is my lidar? 2D lidar localisation by Fourier methods, in JAX.

A tour of the house, in the order in which data passes through it:

- `geometry`: planar poses [x, y, θ] and how they chain.
- `world`: what surrounds the robot. `load_map` reads a ROS map; `OccupancyGrid` and
  `PolygonMap` hold one; `buildings` draws floor plans out of nothing.
- `sensing`: what a lidar sees. `Scan` tidies a real one; `raycast` makes a virtual
  one, exactly, with its exact derivative; `Lidar` adds the noise; `panorama` brings
  any scan to equiangular rays.
- `alignment`: one scan against another. Orientation by circular correlation, position
  by the first harmonic, `caer` for how alike two scans are, and descent on exact
  derivatives. `match` puts them together: a scan, a map, and about where.
  `match_scans` needs no map: the first of two scans is the world of the second.
  `register_images` does it with pictures.
- `calibration`: what all scans have in common and nobody has measured: where the lidar
  sits in the robot, the map's metre and place, bias, scale and noise of the ranges.
- `localisation`: where am I. `build_atlas` scans a map once; `localise` finds one
  scan in it, `localise_batch` many. `tracker` keeps one pose up at sensor rate;
  `follow` and `track` do all of it: found, tracked, kidnapped, found again.
  `particles` keeps a cloud of poses instead of one (Monte Carlo localisation).
- `slam`: no map at all. Landmarks found by range and bearing, and the vehicle among
  them (FastSLAM, L-SLAM, EKF-SLAM).
- `benchmark`: how fast is it here.
- `evaluation`, `io`, `plotting` and the `fsmsm` command line stand at the edge.

Everything is a pure function of arrays and pytrees: write for one, `jax.vmap` for
many, `jax.jit` at the entry, `jax.grad` anywhere.
"""

from fsmsm_jax import geometry as geometry
from fsmsm_jax.world import (
    OccupancyGrid as OccupancyGrid,
    PolygonMap as PolygonMap,
    buildings as buildings,
    load_map as load_map,
    save_map as save_map,
)
from fsmsm_jax.sensing import (
    Lidar as Lidar,
    Scan as Scan,
    panorama as panorama,
    raycast as raycast,
)
from fsmsm_jax.alignment import (
    FastConfig as FastConfig,
    FsmsmConfig as FsmsmConfig,
    Match as Match,
    caer_at,
    match as match,
    match_batch as match_batch,
    match_scans as match_scans,
    match_scans_batch as match_scans_batch,
    refine as refine,
    register_images as register_images,
)
from fsmsm_jax import calibration as calibration
from fsmsm_jax.localisation import (
    AtlasConfig as AtlasConfig,
    Fix as Fix,
    FollowConfig as FollowConfig,
    Localisation as Localisation,
    OdometryModel as OdometryModel,
    Reading as Reading,
    ScanAtlas as ScanAtlas,
    SearchConfig as SearchConfig,
    Track as Track,
    TrackerConfig as TrackerConfig,
    build_atlas as build_atlas,
    follow as follow,
    localise as localise,
    localise_batch as localise_batch,
    memory_estimate as memory_estimate,
    particles as particles,
    track as track,
    tracker as tracker,
)
from fsmsm_jax import slam as slam

caer = caer_at
__version__ = "0.1.0"
