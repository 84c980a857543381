"""Engines that run filters over episodes: for agents, over whole tracks, and for smoothing."""
