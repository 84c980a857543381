"""Measurement logs become tracks (paper, Algorithm 1), and tracks become files and scores."""
