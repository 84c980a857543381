"""Measurement logs and TUM trajectories: readers, checks."""
