"""Sweeps: grids of evaluations and trainings, searches, and the rows that they write."""
