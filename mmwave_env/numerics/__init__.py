"""Vocabulary of the equations: numbers, small matrices and trees of numbers, without numba."""
