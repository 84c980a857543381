"""Filters run over episodes: for agents, along whole tracks, as an IMM, and back again."""
