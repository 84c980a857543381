"""Measurements of the paper's tables and claims: sections for mmwave-loc tables."""
