"""What the ray tracer's process asks Dr.Jit for."""

from types import SimpleNamespace

detail = SimpleNamespace(llvm_version=lambda: (15, 0, 6))
