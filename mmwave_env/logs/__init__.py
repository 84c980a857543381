"""Measurement logs and TUM tracks as files, streamed; what they mean is for others to say."""
