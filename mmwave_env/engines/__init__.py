"""Engines that run filters over episodes: for agents, over whole tracks, as IMM, and backwards."""
