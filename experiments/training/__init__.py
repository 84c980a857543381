"""Learned switchers: environment, network, trainer, checkpoints."""
