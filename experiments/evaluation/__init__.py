"""Evaluation of contenders on the same episodes: seeds, runs, statistics and tables."""
