"""Tests of the rules in docs/architecture.md for imports between rooms (folders or modules)."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter

from tests.cli import printed
from tests.paths import ROOT

EVERYBODY = {"mmwave_env", "io", "metrics"}  # all rooms may import these
FILTER_SIDE = {"numerics", "models", "filters"}
WORLDS = FILTER_SIDE | {"compiler", "world", "interface", "task"}
ENVIRONMENT = WORLDS | {"engines", "rendering"}
MMWAVE_ENV = ENVIRONMENT | {"datasets", "logs", "localization", "env", "vector_env", "sb3"}
LIBRARY = MMWAVE_ENV | {"policies"}
BELOW = {"experiments.console", "experiments.evaluation"}
SEES = {  # room -> rooms that it may import
    "numerics": set(),
    "compiler": {"numerics"},
    "models": {"numerics"},
    "filters": {"numerics", "models"},  # but never the world
    "logs": {"numerics", "models"},
    "world": {"numerics", "models", "compiler"},  # independent of agents and data sets
    "datasets": {"numerics", "models", "world", "logs"},
    "interface": FILTER_SIDE,
    "task": WORLDS | {"datasets"},  # chooses where episodes come from
    "engines": WORLDS,
    "policies": FILTER_SIDE | {"interface", "compiler"},
    **dict.fromkeys(["env", "vector_env"], frozenset(ENVIRONMENT)),
    "localization": ENVIRONMENT | {"logs"},
    "sb3": {"vector_env"},
    **dict.fromkeys(EVERYBODY, frozenset({"numerics"})),
    "rendering": {"numerics", "models"},  # draws arrays, and needs no filters or episodes
    # All folders of experiments may import the library; all but the console may import the console.
    "experiments.console": LIBRARY,
    "experiments.evaluation": LIBRARY | {"experiments.console"},
    **dict.fromkeys(
        ["experiments.training", "experiments.timing", "experiments.reporting"], LIBRARY | BELOW
    ),
    "experiments.paper": LIBRARY | {"experiments.reporting", *BELOW},
    "experiments.sweeping": LIBRARY | {"experiments.training", *BELOW},
}
SEES["experiments"] = frozenset({*SEES, *LIBRARY})  # the commands, one module each
# limits; an arrow joins a room to a room that it imports
ROOMS = 26
ARROWS_BETWEEN_ROOMS = 200


def room(module):
    """Return a module's room: a folder or file directly in the package, or the package itself."""
    package, *rest = module.split(".")
    if package == "experiments":
        shelf = f"experiments.{rest[0]}" if rest else package
        return shelf if shelf in SEES else package
    return rest[0] if package == "mmwave_env" and rest else package


def imports(path):
    """Yield the modules and names that a file imports, also for type checkers only.

    A call such as import_module(name) counts as an import of :data:`ANY`.
    """
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Call) and BY_NAME.search(ast.unparse(node.func)):
            yield ANY, ""


PACKAGES = ("mmwave_env", "policies", "experiments")
ANY = "any module"
READ = re.compile(r"files\(\"(policies|experiments)")  # reading a file of these packages
BY_NAME = re.compile(r"\b(import_module|__import__|run_module|resolve_name)$")


@cache
def all_imports():
    """Return (module, imported module, imported name) of all imports in our packages."""
    return [
        (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), *pair)
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for pair in imports(path)
    ]


@cache
def arrows():
    """Return all imports of our own modules by our own modules."""
    return [arrow for arrow in all_imports() if arrow[1].split(".")[0] in PACKAGES]


def ends(arrow):
    """Return the rooms of the importing and of the imported module."""
    module, target, name = arrow
    inside = f"{target}.{name}"
    return room(module), room(inside if target in PACKAGES and room(inside) in SEES else target)


def crossings(imported):
    """Return a description of each import that the rules forbid."""
    return [
        f"{arrow[0]} imports {arrow[1]}: {begin} may not import {end}"
        for arrow in imported
        for begin, end in [ends(arrow)]
        if begin != end and end not in SEES[begin] | EVERYBODY
    ]


def circles(edges):
    """Return all rooms (or modules), or raise CycleError if they import each other in a circle."""
    graph = {}
    for a, b in edges:
        if a != b:
            graph.setdefault(a, set()).add(b)
    return list(TopologicalSorter(graph).static_order())


def test_no_import_breaks_the_rules():
    assert not crossings(arrows())


def test_an_import_that_breaks_the_rules_is_described():
    assert crossings([("policies.scripted", "experiments.demo", "")]) == [
        "policies.scripted imports experiments.demo: policies may not import experiments"
    ]


def test_mmwave_env_reads_no_file_of_policies_or_experiments():
    assert not [
        path for path in (ROOT / "mmwave_env").rglob("*.py") if READ.search(path.read_text())
    ]


def test_only_the_entry_point_imports_commands_by_name():
    by_name = {module for module, target, _ in all_imports() if target == ANY}
    agents = "experiments.evaluation.agents"  # imports users' modules, named on the command line
    assert by_name == {"experiments.console.main", agents}
    callers = {module for module, target, _ in arrows() if target == "experiments.console.main"}
    assert callers == {"experiments.console.__main__"}


def test_no_command_imports_another_command():
    commands = {module for module, _, _ in arrows() if room(module) == "experiments"}
    taken = [(a, f"{b}.{name}" if b == "experiments" else b) for a, b, name in arrows()]
    assert not [(a, b) for a, b in taken if {a, b} <= commands]


def test_rooms_and_imports_between_rooms_are_few_and_form_no_circle():
    between = {pair for pair in map(ends, arrows()) if pair[0] != pair[1]}
    assert len(set(circles(between)) - {"mmwave_env"}) <= ROOMS
    assert len(between) <= ARROWS_BETWEEN_ROOMS


def test_imports_between_modules_form_no_circle():
    names = {module for arrow in arrows() for module in arrow[:2]}
    circles(
        (module, f"{target}.{name}" if f"{target}.{name}" in names else target)
        for module, target, name in arrows()
    )


def test_no_module_imports_a_private_name_of_another_module():
    assert not [arrow for arrow in arrows() if re.match("_(?!_version__)", arrow[2])]


def test_importing_the_package_loads_no_heavy_package():
    code = (
        "import sys, mmwave_env\n"
        "print(*{'numba', 'scipy', 'matplotlib', 'torch'} & {m.split('.')[0] for m in sys.modules})"
    )
    assert printed(code) == "\n"
