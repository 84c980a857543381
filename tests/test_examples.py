"""Tests that examples beat the best fixed mode or the policy `guided`, and that notebooks run.

Examples whose libraries are not installed are skipped; `make examples` installs them all.
"""

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from runpy import run_path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.evaluation.compare import compare
from experiments.evaluation.protocol import sites
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.pytree import indices
from mmwave_env.world.episode import columns_of
from mmwave_env.world.keys import keys_of
from tests.paths import ROOT

FOLDER = ROOT / "examples"
# Examples that make data, draw a Pareto front, compare filters or train a localizer, not an agent.
OTHERS = {"raytrace", "sumo", "minari_collect", "mo_front", "recurrent_localizer", "stone_soup"}
EXAMPLES = {path.stem: path for path in sorted(FOLDER.glob("*.py")) if path.stem not in OTHERS}


def imported(source: str) -> set[str]:
    """Return the modules that a script imports."""
    nodes = list(ast.walk(ast.parse(source)))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    return set(names)


def rewards(printed: str) -> dict[str, float]:
    """Return rewards by name, the agent's first, from a table of `compare` or from single lines."""
    row, line = r"\| ([\w-]+) \| (-\d+\.\d+) ±", r"([\w-]+): reward (-\d+\.\d+)"
    lines = re.findall(rf"^(?:{row}|{line})", printed.partition("Paired")[0], re.MULTILINE)
    return {a or c: float(b or d) for a, b, c, d in lines}


def made_before(source: str) -> list[list[str]]:
    """Return the commands, shown in an example's docstring, that make the files it reads."""
    lines = re.findall(r"^python (examples/.*)$", ast.get_docstring(ast.parse(source)) or "", re.M)
    return [[str(ROOT / script), *words] for script, *words in map(shlex.split, lines)]


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_short(name):
    """Check that at most 30 lines follow the imports."""
    source = EXAMPLES[name].read_text("utf-8")
    imports = (n for n in ast.parse(source).body if isinstance(n, ast.Import | ast.ImportFrom))
    begin = max(node.end_lineno for node in imports)
    assert len([line for line in source.splitlines()[begin:] if line.strip()]) <= 30


@pytest.mark.slow
@pytest.mark.release
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_beats_the_best_fixed_mode_or_its_base(name, tmp_path):
    source = EXAMPLES[name].read_text("utf-8")
    for module in imported(source):
        pytest.importorskip(module, exc_type=ImportError)
    paths = {"PYTHONPATH": str(ROOT), "MINARI_DATASETS_PATH": str(tmp_path)}
    for words in [*made_before(source), [str(EXAMPLES[name])]]:
        program, env = [sys.executable, "-W", "ignore", *words], os.environ | paths
        done = subprocess.run(program, env=env, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    reward = rewards(done.stdout)
    bar = "guided" if "guided" in reward else "fixed-ukf"
    assert next(iter(reward.values())) > reward[bar], done.stdout


@pytest.mark.slow
def test_a_front_trades_error_for_consistency():
    pytest.importorskip("mo_gymnasium")
    program = [sys.executable, "-W", "ignore", str(FOLDER / "mo_front.py")]
    printed = subprocess.run(program, check=True, capture_output=True, text=True).stdout
    points = np.array(re.findall(r"error (\S+), inconsistency (\S+):", printed), float)
    assert len(points) > 2 and (np.diff(points[:, 0]) < 0).all()
    assert (np.diff(points[:, 1]) >= 0).all()


@pytest.fixture
def localizer(tmp_path, monkeypatch):
    """Return the names of an example in a folder with the file of an untrained network."""
    monkeypatch.chdir(tmp_path)
    names = SimpleNamespace(**run_path(str(FOLDER / "recurrent_localizer.py")))
    names.save_file(names.Network().state_dict(), names.FILE)
    return names


def on_a_street(**receiver):
    """Return four short episodes."""
    source = replace(sites()[0].source(), epochs=30, **receiver)
    return source.sample_batch(keys_of(range(5_000_000, 5_000_004)))


@pytest.mark.torch
@pytest.mark.parametrize("receiver", [{}, {"measurements": ("range", "azimuth")}, {"clock": True}])
def test_a_localizer_always_states_a_covariance(localizer, receiver):
    batch = on_a_street(**receiver)
    batch.table[:, 10:, columns_of(batch.layout).signed_sigma] = -1.0  # nothing is measured
    x, P = localizer.Localizer().estimate(Pipeline(default_modes(), batch.layout), batch)
    assert np.isfinite(x).all()
    assert (np.linalg.eigvalsh(np.moveaxis(unpack([*P.T]), (0, 1), (-2, -1))) > 0.0).all()


@pytest.mark.torch
def test_a_localizer_knows_no_direction(localizer):
    batch = on_a_street()
    estimator, pipeline = localizer.Localizer(), Pipeline(default_modes(), batch.layout)
    before, _ = estimator.estimate(pipeline, batch)
    at, site = columns_of(batch.layout), indices(blank_site(batch.layout))
    batch.table[:, :, at.z[1 : batch.layout.doppler : 2]] += np.pi / 2  # azimuths
    for x, y in [*(a[:2] for a in site.anchors), site.prior_x[:2], site.prior_x[3:5]]:
        batch.site[:, [x, y]] = batch.site[:, [y, x]] * [-1.0, 1.0]
    after, _ = estimator.estimate(pipeline, batch)
    turned = np.stack([-before[..., 1], before[..., 0], before[..., 2]], axis=-1)
    np.testing.assert_allclose(after[..., :3], turned, atol=0.01)


@pytest.mark.slow
@pytest.mark.torch
def test_a_localizer_learns(localizer):
    localizer.save_file(localizer.train(10_000_000, 12).state_dict(), "trained.safetensors")
    agents = {name: localizer.Localizer(f"{name}.safetensors") for name in ("localizer", "trained")}
    result = compare(agents, beside=(), episodes=20, seed=5_000_000)
    assert result.paired["trained - localizer"]["reward"].low > 0.0


def test_the_docs_list_every_example_with_pinned_versions():
    files = [ROOT / "constraints.txt", *FOLDER.glob("*.txt")]
    pins = re.findall(
        r"^([\w-]+)(?:\[.*\])?==(\S+)$", "\n".join(f.read_text() for f in files), re.M
    )
    row = r"^\| .+? \| `([\w-]+) ([\d.]+)` \|.*\(\.\./examples/(\w+)\.py\)"
    rows = re.findall(row, (ROOT / "docs" / "own-agent.md").read_text("utf-8"), re.M)
    assert {(package, version) for package, version, _ in rows} <= {*pins}
    assert {example for *_, example in rows} == set(EXAMPLES)


NOTEBOOKS = ROOT / "docs" / "notebooks"
STORED = {"first_switcher": 0, "corrector": 5}  # number of pictures stored with a notebook


@pytest.mark.parametrize("name", STORED)
def test_notebooks_are_stored_with_their_pictures_alone(name):
    notebook = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text("utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] is None for cell in code)
    assert all(cell["metadata"] == {} for cell in notebook["cells"])
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    assert set(notebook["metadata"]["language_info"]) == {"name"}  # without the version of Python
    outputs = [output for cell in code for output in cell["outputs"]]
    assert sum("image/png" in output["data"] for output in outputs) == STORED[name]
    assert STORED[name] or outputs == []


def outputs_of(name):
    """Run a notebook; return what it printed, and the data that it showed."""
    nbclient, nbformat = map(pytest.importorskip, ("nbclient", "nbformat"))
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    folder = {"metadata": {"path": NOTEBOOKS}}  # where Jupyter runs it
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
        nbclient.NotebookClient(notebook, resources=folder, timeout=600).execute()
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    printed = "".join(output["text"] for output in outputs if output.get("name"))
    return printed, [output["data"] for output in outputs if "data" in output]


@pytest.mark.slow
def test_the_notebook_of_the_corrector_shows_that_every_step_helps():
    _, shown = outputs_of("corrector")
    assert sum("image/png" in data for data in shown) == STORED["corrector"]
    errors = ast.literal_eval(shown[0]["text/plain"])
    assert errors["speed-rule"] > errors["imm-best"] > errors["guided"] > errors["corrector"]
    (table,) = (data["text/markdown"] for data in shown if "text/markdown" in data)
    gaussian, calibrated = (float(share) for share in re.findall(r"([\d.]+) %", table))
    assert gaussian > 0.3 > calibrated


@pytest.mark.slow
@pytest.mark.torch
def test_the_notebook_runs_and_its_agent_beats_the_rules():
    printed, shown = outputs_of("first_switcher")
    assert "Warning: speed" not in printed
    assert sum("image/png" in data for data in shown) == 3
    (tables,) = (data["text/markdown"] for data in shown if "text/markdown" in data)
    header, mine = (
        [cell.strip() for cell in line.split("|")]
        for line in tables.partition("Paired differences")[2].splitlines()
        if line.startswith(("| reward of", "| mine"))
    )
    for other in ("speed-rule", "fixed-ukf"):  # significantly better than both
        assert float(re.findall(r"\[(.*?),", mine[header.index(f"minus {other}")])[0]) > 0.0
