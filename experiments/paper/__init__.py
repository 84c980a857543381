"""The paper's tables and claims, measured: sections for mmwave-loc tables."""
