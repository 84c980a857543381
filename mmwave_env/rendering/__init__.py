"""Rendering of episodes as pictures; needs the extra ``render``."""
