"""Timing of environments and filters, and the speed limit of a core, for ``mmwave-loc speed``."""
