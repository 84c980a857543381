"""Training of policies that choose filters: environments, networks, trainers and checkpoints."""
