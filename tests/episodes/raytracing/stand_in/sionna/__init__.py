"""Takes the place of Sionna in the process of the ray tracer, where it is not installed."""
