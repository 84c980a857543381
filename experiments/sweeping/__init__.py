"""Grids of evaluations and trainings: what to do, who does it, and what is kept of it."""
