"""Measurements that test the paper's tables and claims, as sections for mmwave-loc tables."""
