"""Training of switchers: Stable-Baselines3 on the native vector environment."""
