"""Recordings from the ray tracer Sionna RT: from its paths, or along a way, in a child process."""
