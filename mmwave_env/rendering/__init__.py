"""Rendering of an episode as pictures, which needs the extra ``render``."""
