"""Commands: thin pages over mmwave_env and policies."""
