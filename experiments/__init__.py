"""Commands: thin modules over mmwave_env and policies."""
