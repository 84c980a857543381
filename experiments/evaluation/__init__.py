"""Evaluation of contenders on the same episodes: selection, runs, statistics and tables."""
