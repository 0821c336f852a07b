"""Parts of `reproduce_lslam.py`."""
