"""Data sets: DeepMIMO scenarios, measurement logs and samples, as sources of episodes."""
