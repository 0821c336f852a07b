"""What has which colour in all pictures."""

__all__ = ["DOUBT", "INK", "POSE", "RIVAL", "SCAN", "TRUTH", "UNKNOWN", "WALL"]

WALL, UNKNOWN = "#2e3440", "#e9e7e1"
SCAN, POSE, RIVAL, TRUTH = "#e4572e", "#1d4e89", "#8a6fb3", "#2a9d5c"
INK, DOUBT = "#333333", "#b3541e"
