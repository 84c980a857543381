"""Compilation of functions of numbers to machine code: lanes, kernels, threads, a disk cache."""
