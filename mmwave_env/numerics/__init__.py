"""Building blocks of the equations: numbers, small matrices and trees of numbers."""
