"""Parts of `reproduce_particles.py`."""
