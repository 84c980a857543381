"""Provenance of results: the command and the versions that made them."""

import platform
import shlex
from dataclasses import fields, replace
from importlib.metadata import version
from typing import Any, get_type_hints

from experiments.console.parser import is_positional
from mmwave_env import __version__

OUTPUTS = {"json", "episodes_csv", "errors", "consistency", "plot", "docs", "out"}


def command_line(name: str, args: Any) -> str:
    """Return the command that a dataclass of arguments stands for, without defaults."""
    kinds = get_type_hints(type(args), include_extras=True)
    nameless = [field.name for field in fields(args) if is_positional(kinds[field.name])]
    values = [value for field in nameless if (value := getattr(args, field)) is not None]
    words = ["mmwave-loc", name, *(word for value in values for word in _words(value))]
    for field in fields(args):
        value, option = getattr(args, field.name), field.name.replace("_", "-")
        if field.name in nameless or value == field.default:
            continue
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", *_words(value)]
    return shlex.join(words)


def _words(value: Any) -> list[str]:
    return [*map(str, value if isinstance(value, tuple) else (value,))]


def provenance(name: str, args: Any) -> dict[str, Any]:
    """Return the command without its outputs, and versions, for results in JSON."""
    outputs = {f.name: f.default for f in fields(args) if f.name in OUTPUTS}
    return {"command": command_line(name, replace(args, **outputs)), "versions": versions()}


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of others, for a policy file."""
    return {"mmwave-loc": __version__} | {name: version(name) for name in packages}


def versions() -> dict[str, str]:
    """Return versions of the package, of Python and of the packages that numbers depend on."""
    packages = {name: version(name) for name in ("gymnasium", "numpy", "numba", "scipy")}
    return {"mmwave-loc": __version__, "python": platform.python_version(), **packages}
