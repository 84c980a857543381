"""Tests that example agents beat simple rivals, that other examples work, and that notebooks run.

The rival is the policy `guided` if the example prints the reward of `guided`, else `fixed-ukf`.
Examples whose libraries are not installed are skipped; `make examples` installs them all.
"""

import ast
import gzip
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, distribution
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.compare import compare
from experiments.evaluation.protocol import sites
from mmwave_env.datasets.deepmimo import read_deepmimo
from mmwave_env.datasets.ways import read_ways
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import default_modes
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.linalg import unpack
from mmwave_env.task import task_from
from mmwave_env.world.episode import columns_of
from mmwave_env.world.keys import keys_of
from tests.cli import environment
from tests.datasets.deepmimo.scenarios import rays
from tests.filters.tracks import sampled
from tests.pages import run_notebook
from tests.paths import RECORDINGS, ROOT, loaded

FOLDER = ROOT / "examples"
# Examples without an agent: they make data, draw a Pareto front, or compare or train localizers.
OTHERS = {
    "raytrace",
    "sumo",
    "minari_collect",
    "mo_front",
    "recurrent_localizer",
    "rivals",
    "safe_imm",
    "stone_soup",
    "unknown_map",
}
EXAMPLES = {path.stem: path for path in sorted(FOLDER.glob("*.py")) if path.stem not in OTHERS}


def imported(source):
    """Return the modules that a script imports."""
    nodes = list(ast.walk(ast.parse(source)))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    return set(names)


def rewards(printed):
    """Return name -> reward, agent first, from a table of `compare` or lines "NAME: reward ..."."""
    row = r"\| ([\w-]+) \| (-\d+\.\d+) ±"
    line = r"([\w-]+): reward (-\d+\.\d+)"
    lines = re.findall(rf"^(?:{row}|{line})", printed.partition("Paired")[0], re.MULTILINE)
    return {a or c: float(b or d) for a, b, c, d in lines}


def made_before(source):
    """Return the commands in an example's docstring; they make the files that the example reads."""
    lines = re.findall(r"^python (examples/.*)$", ast.get_docstring(ast.parse(source)) or "", re.M)
    return [[str(ROOT / script), *words] for script, *words in map(shlex.split, lines)]


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_short(name):
    """Check that at most 40 lines follow the imports."""
    source = EXAMPLES[name].read_text("utf-8")
    imports = (n for n in ast.parse(source).body if isinstance(n, ast.Import | ast.ImportFrom))
    begin = max(node.end_lineno for node in imports)
    assert len([line for line in source.splitlines()[begin:] if line.strip()]) <= 40


def run(script, *options, cwd, **variables):
    """Run a Python file with options and environment variables; return what it prints."""
    words = [sys.executable, "-W", "ignore", *map(str, (script, *options))]
    more = {"cwd": cwd, "env": environment() | variables}
    done = subprocess.run(words, capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.release
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_beats_guided_or_the_fixed_ukf(name, tmp_path):
    source = EXAMPLES[name].read_text("utf-8")
    for module in imported(source):
        pytest.importorskip(module, exc_type=ImportError)
    for words in [*made_before(source), [EXAMPLES[name]]]:
        printed = run(*words, cwd=tmp_path, MINARI_DATASETS_PATH=str(tmp_path))
    reward = rewards(printed)
    bar = "guided" if "guided" in reward else "fixed-ukf"
    assert next(iter(reward.values())) > reward[bar], printed


@pytest.mark.slow
def test_along_the_pareto_front_a_smaller_error_costs_consistency(tmp_path):
    pytest.importorskip("mo_gymnasium")
    printed = run(FOLDER / "mo_front.py", cwd=tmp_path)
    points = np.array(re.findall(r"error (\S+), inconsistency (\S+):", printed), float)
    assert len(points) > 2 and (np.diff(points[:, 0]) < 0).all()
    assert (np.diff(points[:, 1]) >= 0).all()


@pytest.mark.slow
def test_without_a_map_an_entry_is_worth_more_than_the_line_of_sight_alone():
    names = loaded("examples/unknown_map.py")
    seeds = range(5_000_000, 5_000_003)
    *_, score = names.row(names.learned, "standard", seeds)
    assert float(score.split()[0]) > 50.0

    def silent(log, scene, radio):
        return []

    sight, own, known = names.errors_m(silent, "standard", 5_000_000)
    assert own == names.MISSING_M and known < sight < own


@pytest.fixture
def localizer(tmp_path, monkeypatch):
    """Run recurrent_localizer.py, save an untrained network, and return the script's variables."""
    monkeypatch.chdir(tmp_path)
    names = loaded("examples/recurrent_localizer.py")
    names.save_file(names.Network().state_dict(), names.FILE)
    return names


@pytest.mark.torch
@pytest.mark.parametrize(
    "receiver", [{}, {"measurements": ("range", "azimuth")}, {"clock": "offset"}]
)
def test_the_covariances_of_a_localizer_are_always_positive_definite(localizer, receiver):
    source = replace(sites()[0].source(), epochs=30, **receiver)
    batch = source.sample_batch(keys_of(range(5_000_000, 5_000_004)))
    batch.table[:, 10:, columns_of(batch.layout).signed_sigma] = -1.0  # no measurements
    x, P = localizer.Localizer().estimate(Pipeline(default_modes(), batch.layout), batch)
    assert np.isfinite(x).all()
    assert (np.linalg.eigvalsh(np.moveaxis(unpack([*P.T]), (0, 1), (-2, -1))) > 0.0).all()


@pytest.mark.slow
@pytest.mark.torch
def test_a_localizer_learns(localizer):
    localizer.save_file(localizer.train(10_000_000, 12).state_dict(), "trained.safetensors")
    agents = {name: localizer.Localizer(f"{name}.safetensors") for name in ("localizer", "trained")}
    result = compare(agents, beside=(), episodes=20, seed=5_000_000)
    assert result.paired["trained - localizer"]["reward"].low > 0.0


def test_the_docs_list_every_example_with_the_group_that_it_needs():
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["dependency-groups"]
    row = r"^\| .+? \| `(\w+)` \|.*\(\.\./examples/(\w+)\.py\)"
    rows = re.findall(row, (ROOT / "docs" / "own-agent.md").read_text("utf-8"), re.M)
    needed, examples = zip(*rows, strict=True)
    assert groups.keys() >= {*needed}
    assert set(examples) == set(EXAMPLES)


NOTEBOOKS = ROOT / "docs" / "notebooks"


def outputs_of(name):
    """Run a notebook; return what it printed, and the data that it showed."""
    pytest.importorskip("nbclient")
    notebook = run_notebook(NOTEBOOKS / f"{name}.ipynb")
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    printed = "".join(output["text"] for output in outputs if output.get("name"))
    return printed, [output["data"] for output in outputs if "data" in output]


@pytest.mark.slow
def test_the_notebook_of_the_corrector_shows_that_every_step_helps():
    _, shown = outputs_of("corrector")
    assert sum("image/png" in data for data in shown) == 5
    errors = ast.literal_eval(shown[0]["text/plain"])
    assert errors["speed-rule"] > errors["imm-best"] > errors["guided"] > errors["corrector"]
    (table,) = (data["text/markdown"] for data in shown if "text/markdown" in data)
    gaussian, calibrated = (float(share) for share in re.findall(r"([\d.]+) %", table))
    assert gaussian > 0.3 > calibrated


@pytest.mark.slow
@pytest.mark.torch
def test_the_agent_of_the_first_notebook_beats_the_speed_rule_and_the_ukf():
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


# --- SUMO


PERSON = '<vehicle id="walker"', '<person id="walker"'


def write_traffic(path):
    """Write a file as `sumo --fcd-output` does: a car, a pedestrian, and trips to be left out."""
    steps = []
    for t in range(91):
        users = {"car": (60 + t, 100), "walker": (60, 30 + t), "lost": (60 + t, 100 + 2 * t)}
        users |= {"brief": (t, 9)} if t < 20 else {}
        rows = [f'<vehicle id="{i}" x="{x}" y="{y}" speed="1.0"/>' for i, (x, y) in users.items()]
        steps.append(f'<timestep time="{t}.00">{"".join(rows)}</timestep>'.replace(*PERSON))
    content = f"<?xml version='1.0'?>\n<fcd-export>{''.join(steps)}</fcd-export>\n".encode()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)


@pytest.mark.parametrize("name", ["traffic.xml", "traffic.xml.gz"])
def test_trips_are_written_as_trajectories_from_which_episodes_are_drawn(tmp_path, name):
    write_traffic(tmp_path / name)
    text = run(FOLDER / "sumo.py", name, "ways.csv", "--shift", 0, -140, cwd=tmp_path)
    for part in (
        "4 trips",
        "left out: lost, row 34",
        "1 trips left out",
        "2 ways written to ways.csv",
    ):
        assert part in text
    car, walker = read_ways(tmp_path / "ways.csv").trajectories
    assert_array_equal(car.time_s, np.arange(91.0))
    assert_array_equal(car.position_m[[0, -1]], [[60, -40, 1.5], [150, -40, 1.5]])
    source = task_from(scenario=tmp_path / "ways.csv", episode_steps=60).source
    names = {sampled(source, seed).name for seed in range(9)}
    assert names == {car.name, walker.name}


def test_the_traffic_is_moved_to_the_middle_of_the_street(tmp_path, capsys):
    write_traffic(tmp_path / "traffic.xml")
    sumo = loaded("examples/sumo.py")
    street = SCENES["street"]
    sumo.ways_in(street, sumo.read_trips(tmp_path / "traffic.xml"), 60.0)
    assert "moved by (5.0, -224.5) m" in capsys.readouterr().out  # trips span x 0..150, y 9..280 m


@pytest.mark.slow
def test_sumo_makes_traffic(tmp_path):
    try:
        distribution("eclipse-sumo")
    except PackageNotFoundError:
        pytest.skip("needs pip install --group sumo")
    run(FOLDER / "sumo.py", "--make", 120, "town.xml.gz", "ways.csv", "--least", 40, cwd=tmp_path)
    assert len(read_ways(tmp_path / "ways.csv").trajectories) > 9


# --- ray tracing

STATION = np.array([-5.0, 4.0, 6.0])
WALL = (np.array([0.0, 1.0, 0.0]), 10.0)  # normal and offset of the plane y = 10
USERS = np.column_stack([np.linspace(0.0, 20.0, 21), np.full(21, -2.0), np.full(21, 1.5)])


def sionna_paths(users_m, hidden=()):
    """Return the parts of Sionna RT's paths that the example reads, for a street with one wall.

    Axes are [receiver, transmitter, path]; arrays of interactions have a depth axis before these.
    The line of sight is the second path; hidden receivers lack it.
    """
    aim, length, bounce = rays(STATION, users_m, [WALL])
    length = length[:, ::-1]
    valid = np.ones((len(users_m), 1, 2), bool)
    valid[list(hidden), 0, 1] = False
    angles = {}
    for end, unit in zip("rt", aim[:, :, ::-1], strict=True):
        x, y, z = np.moveaxis(unit, -1, 0)
        angles[f"phi_{end}"] = np.arctan2(y, x)[:, None]
        angles[f"theta_{end}"] = np.arctan2(np.hypot(x, y), z)[:, None]
    gain = (1e-3 / length)[:, None, None, None]
    kinds = np.broadcast_to([1, 0], (1, len(users_m), 1, 2))
    tau = (length / SPEED_OF_LIGHT)[:, None]
    paths = {
        "a": (gain, 0.0 * gain),
        "tau": tau,
        "valid": valid,
        "vertices": bounce[None, :, None, ::-1],
    }
    return SimpleNamespace(interactions=kinds, **paths, **angles)


def test_traced_paths_are_written_to_a_folder_and_read_back(tmp_path):
    """Write arrays shaped like those of Sionna RT 2.2; the next test runs Sionna RT itself."""
    raytrace = loaded("examples/raytrace.py")
    velocity = np.tile([10.0, 0.0, 0.0], (21, 1))
    traced = sionna_paths(USERS[:12], hidden=[3]), sionna_paths(USERS[12:])
    blocks = [raytrace.arrays_of(paths) for paths in traced]
    arrays = {key: raytrace.joined([block[key] for block in blocks]) for key in blocks[0]}
    track = np.hstack([USERS, velocity])
    raytrace.write_folder(tmp_path / "way", arrays, 28e9, STATION, 0.1 * np.arange(21), track)
    recording = read_deepmimo(tmp_path / "way")
    assert_allclose(recording.anchors_m, [STATION, [-5.0, 16.0, 6.0]], atol=1e-4)
    assert recording.visible[:, 0].tolist() == [row != 3 for row in range(21)]
    assert recording.visible[:, 1].all()
    assert_array_equal(recording.velocity_mps, velocity)
    direct = np.linalg.norm(USERS - STATION, axis=1)
    sight = recording.visible[:, 0]
    assert_allclose(recording.measurement[sight, 0], direct[sight], atol=1e-4)
    loss = 20.0 * np.log10(1e-3 / direct[sight])
    assert_allclose(recording.path_gain_db[sight, 0], loss, atol=1e-4)
    assert len(sampled(task_from(episodes=tmp_path / "way").source)) == 21


@pytest.mark.slow
def test_tracing_a_shipped_recording_again_gives_the_same_measurements(tmp_path):
    pytest.importorskip("sionna.rt", reason="needs pip install --group raytrace")
    shipped = RECORDINGS / "canyon28_walk_ride_walk"
    run(FOLDER / "raytrace.py", shipped / "trajectory.csv", tmp_path / "again", cwd=tmp_path)
    again = read_deepmimo(tmp_path / "again")
    expected = read_deepmimo(shipped)
    assert_array_equal(again.visible, expected.visible)
    rows = np.repeat(expected.visible, [4, 4, 4, 1], axis=1)
    assert_allclose(again.measurement[rows], expected.measurement[rows], atol=1e-4)
