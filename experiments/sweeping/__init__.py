"""Grids of evaluations and trainings, and searches: what to do, by whom, and what is kept."""
