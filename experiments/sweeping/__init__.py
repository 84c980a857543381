"""Sweeps (grids of evaluations or training runs, or searches), and the rows that they write."""
