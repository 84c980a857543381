"""Engines that run filters on episodes: step by step for an agent, or from start to end."""
