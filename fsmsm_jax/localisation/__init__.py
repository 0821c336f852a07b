"""Where am I: the atlas of a map, and the search through it."""

from fsmsm_jax.localisation.atlas import (
    AtlasConfig as AtlasConfig,
    ScanAtlas as ScanAtlas,
    build_atlas as build_atlas,
    memory_estimate as memory_estimate,
)
from fsmsm_jax.localisation.search import (
    Localisation as Localisation,
    SearchConfig as SearchConfig,
    localise as localise,
    localise_batch as localise_batch,
)
