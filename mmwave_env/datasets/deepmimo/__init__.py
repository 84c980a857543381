"""DeepMIMO scenarios: :func:`read_deepmimo` reads a folder as a recording (docs/deepmimo.md)."""

from mmwave_env.datasets.deepmimo.recording import read_deepmimo

__all__ = ["read_deepmimo"]
