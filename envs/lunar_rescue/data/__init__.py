"""Data files: postures and robot."""
