"""fsmsm_jax."""
from fsmsm_jax import geometry as geometry
