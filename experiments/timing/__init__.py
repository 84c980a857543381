"""Timing for mmwave-loc speed: environments, filters and the limit of a processor core."""
