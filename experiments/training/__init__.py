"""Training of switchers: environments, networks, trainers and checkpoints."""
