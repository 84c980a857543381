"""What holds for all tests."""

import os

# Tests run side by side, one to a core; threads of torch and BLAS on top only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
