"""Measurement logs and TUM trajectories: readers, checks, and an estimate of clock offsets."""
