"""Functions of numbers become machine code: lanes, kernels, threads and what is kept on disk."""
