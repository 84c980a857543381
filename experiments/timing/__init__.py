"""Timing for mmwave-loc speed: environments, filters and the limit of the core."""
