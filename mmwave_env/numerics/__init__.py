"""What the equations are written in: numbers, small matrices, trees of numbers; no numba here."""
