"""Sweeps (grids of evaluations or training runs), and the rows that they write."""
