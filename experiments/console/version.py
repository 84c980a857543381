"""Versions, threads and cached kernels (compiled functions): ``mmwave-loc --version --json``."""

import os
import platform

import numba
from llvmlite.binding import get_host_cpu_name

from experiments.console.provenance import versions
from mmwave_env.compiler.disk_cache import kept_functions
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.io.files import Json


def about() -> Json:
    """Return the report as JSON."""
    return {
        "versions": versions(),
        "system": platform.platform(),
        "processor": numba.config.CPU_NAME or str(get_host_cpu_name()),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "environments_at_a_time": WIDTH,
        "kernels": kept_functions(),
    }
