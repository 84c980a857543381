"""Files, names, and dataclasses as JSON: all that comes from outside, and atomic writing."""
