"""The walls between rooms (docs/architecture.md): who may import whom, and no circle."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter

import pytest

from tests.paths import ROOT

EVERYBODY = {"mmwave_env", "files", "lookup", "metrics", "records"}  # the first: __init__.py
FILTER_SIDE = {"numerics", "models", "filters"}
FACE = {"features", "observation", "reward", "info", "task"}
WORLDS = FILTER_SIDE | {"compiler", "world"} | FACE
ENVIRONMENT = WORLDS | {"engines", "rendering"}
LIBRARY = ENVIRONMENT | {"datasets", "logs", "policies", "localization", "env", "vector_env", "sb3"}
SEES = {
    "numerics": set(),
    "compiler": {"numerics"},
    "models": {"numerics"},
    "filters": {"numerics", "models"},  # and never the world:
    "logs": {"numerics", "models"},
    "world": {"numerics", "models", "compiler"},  # no agent changes it, and it knows no data set
    "datasets": {"numerics", "models", "world", "logs"},
    **dict.fromkeys(["features", "observation", "reward"], frozenset(FILTER_SIDE | FACE)),
    "task": WORLDS | {"datasets"},  # chooses where episodes come from
    "engines": WORLDS,
    "policies": FILTER_SIDE | FACE,
    **dict.fromkeys(["env", "vector_env"], frozenset(ENVIRONMENT)),
    "localization": ENVIRONMENT | {"logs"},
    "sb3": {"vector_env"},
    **dict.fromkeys([*EVERYBODY, "info"], frozenset({"numerics"})),
    "rendering": {"numerics", "models"},  # streets, and numbers: no filter and no episode
    "experiments": LIBRARY,
}
# of the commands:
BELOW = {"console", "evaluation", "figures"}
SEES_INSIDE = {  # experiments; "" are the commands, one a page
    "console": set(),  # progress, tables, options, signals: everybody sees it
    "evaluation": {"console"},
    **dict.fromkeys(["figures", "training", "tuning"], frozenset({"console", "evaluation"})),
    **dict.fromkeys(["paper", "timing", "comparing", "localization"], frozenset(BELOW)),
    "sweeping": {"console", "evaluation", "training"},
    "webpage": BELOW | {"localization"},
}
SEES_INSIDE[""] = frozenset(SEES_INSIDE)


def room(module):
    """The room of a module: a folder or a file at the front of mmwave_env, or a package beside."""
    package, *rest = module.split(".")
    return rest[0] if package == "mmwave_env" and rest else package


def runs(node):
    """A node and all in it, without what is there for type checkers alone."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from runs(child)


def imports(path):
    """Modules of ours that a file imports, and names that it takes from them, but for types."""
    for node in runs(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def shelf(module):
    """The folder in experiments that a module lies in; empty for a command."""
    name = module.split(".")[1] if "." in module else ""
    return name if name in SEES_INSIDE else ""


PACKAGES = ("mmwave_env", "policies", "experiments")
ARROWS = [
    (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), found, name)
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
    for found, name in imports(path)
    if found.split(".")[0] in PACKAGES
]


def crossings(arrows):
    """Arrows through a wall: room, module that imports, module imported."""
    for module, found, name in arrows:
        target = f"{found}.{name}" if found == "mmwave_env" and name in SEES else found
        here, there = room(module), room(target)
        if here != there and there not in SEES[here] | EVERYBODY:
            yield f"{module} imports {target}: {here} may not see {there}"


def crossings_inside(arrows):
    """The same between the folders of experiments."""
    for module, found, name in arrows:
        if room(module) == room(found) == "experiments":
            target = f"{found}.{name}" if found == "experiments" else found
            here, there = shelf(module), shelf(target)
            if here != there and there not in SEES_INSIDE[here]:
                yield f"{module} imports {target}"


def circles(edges):
    """Raises CycleError where rooms (or modules) import each other in a circle."""
    graph = {}
    for a, b in edges:
        if a != b:
            graph.setdefault(a, set()).add(b)
    return list(TopologicalSorter(graph).static_order())


def test_no_import_goes_through_a_wall():
    assert not list(crossings(ARROWS))
    assert not list(crossings_inside(ARROWS))


@pytest.mark.parametrize(
    ("module", "found"),
    [
        ("mmwave_env.filters.update", "mmwave_env.world.episode"),
        ("policies.scripted", "experiments.demo"),
    ],
)
def test_a_broken_wall_is_named(module, found):
    assert list(crossings([(module, found, "")])) == [
        f"{module} imports {found}: {room(module)} may not see {room(found)}"
    ]


def test_a_broken_wall_between_commands_and_their_libraries_is_named():
    arrow = ("experiments.evaluation.runner", "experiments.compare", "Args")
    assert list(crossings_inside([arrow])) == [f"{arrow[0]} imports {arrow[1]}"]


def test_there_is_no_circle_of_rooms_and_none_of_modules():
    rooms = circles((room(module), room(found)) for module, found, _ in ARROWS)
    assert len(set(rooms) | set(SEES)) <= 26
    names = {module for module, _, _ in ARROWS} | {found for _, found, _ in ARROWS}
    circles(
        (module, f"{found}.{name}" if f"{found}.{name}" in names else found)
        for module, found, name in ARROWS
    )


def test_nothing_private_crosses_modules():
    taken = [(module, found, name) for module, found, name in ARROWS if name.startswith("_")]
    assert not [arrow for arrow in taken if arrow[2] != "__version__"]


def test_importing_the_package_loads_nothing_heavy():
    code = (
        "import sys, mmwave_env\n"
        "print(*{'numba', 'scipy', 'matplotlib', 'torch'} & {m.split('.')[0] for m in sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.strip() == "", done.stderr
