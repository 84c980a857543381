"""DeepMIMO scenarios: :func:`read_deepmimo` makes a recording of a folder (docs/deepmimo.md)."""

from mmwave_env.datasets.deepmimo.recording import read_deepmimo

__all__ = ["read_deepmimo"]
