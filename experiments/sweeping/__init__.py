"""Sweeps (grids of evaluations or trainings, or searches), and the rows of results they write."""
