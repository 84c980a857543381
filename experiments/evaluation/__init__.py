"""Contenders on the same episodes: who they are, how they are run, what is made of it."""
