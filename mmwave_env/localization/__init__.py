"""Localization: tracks from measurement logs (paper, Algorithm 1), their files and their scores."""
