"""Tests of the program mmwave-loc: its help, its messages about mistakes, and its output."""

import importlib
import json
import os
import pty
import re
import shlex
import subprocess
import sys

import pytest

import mmwave_env
from experiments.console.main import COMMANDS, read_arguments
from experiments.console.options import IntegrityArgs, TaskArgs
from tests.cli import (
    assert_one_clear_line,
    assert_printable,
    assert_refused,
    command,
    environment,
    printed,
    python,
    started,
    succeed,
)
from tests.paths import ROOT, json_in

# These packages take long to import.
HEAVY = {"numba", "gymnasium", "numpy", "scipy", "matplotlib", "torch", "rich", "pyarrow"}

# --- help and mistakes


def test_the_program_lists_its_commands_and_shows_its_version():
    helped = command("--help")
    bare = command()
    assert helped.returncode == 0 and bare.returncode == 2
    assert all(name in helped.stdout for name in COMMANDS) and helped.stdout == bare.stdout
    assert succeed("--version") == f"mmwave-loc {mmwave_env.__version__}\n"
    versions = json.loads(succeed("--version", "--json"))
    assert versions["mmwave-loc"] == mmwave_env.__version__
    assert {"numba", "numpy", "gymnasium", "python"} < set(versions)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_its_options(name):
    shown = command(name, "--help", columns=80).stdout
    usage, *lines = shown.splitlines()
    assert usage.startswith(f"usage: mmwave-loc {name} ") and max(map(len, lines)) <= 80
    examples = re.findall(r"^ (?: {4})?mmwave-loc (.*)$", shown, re.MULTILINE)
    assert examples
    for example in examples:
        typed, *words = shlex.split(example)
        assert typed == name
        read_arguments(name, words)


def test_the_help_of_compare_lists_the_names_that_its_options_accept():
    from experiments.evaluation.contenders import contenders
    from mmwave_env.datasets.samples import sample_names
    from mmwave_env.models.radio import RADIOS
    from mmwave_env.models.scene import SCENES
    from mmwave_env.world.mobility import MOBILITIES

    words = set(re.findall(r"[\w-]+", command("compare", "--help", columns=80).stdout))
    names = (*contenders("handset"), *sample_names(), *RADIOS, *SCENES, *MOBILITIES, "mixed")
    assert not {*names, "clairvoyant", "tracking", "log-score"} - words


@pytest.mark.parametrize("columns", [0, 20, 80])
def test_help_fits_80_columns(columns):
    for words in (("compare", "--help"), ("--help",)):
        shown = command(*words, columns=columns).stdout
        assert 60 < max(map(len, shown.splitlines())) <= 80


def test_help_loads_no_heavy_packages():
    code = (
        "import sys\n"
        "from experiments.console.main import COMMANDS, read_arguments\n"
        "for name in COMMANDS:\n"
        "    try:\n"
        "        read_arguments(name, ['--help'])\n"
        "    except SystemExit:\n"
        "        pass\n"
        f"print('loaded:', *{HEAVY} & {{m.split('.')[0] for m in sys.modules}})"
    )
    assert printed(code).splitlines()[-1] == "loaded:"


def test_shells_complete_commands_and_options():
    for shell in ("bash", "zsh", "fish"):
        script = succeed("--tyro-print-completion", shell)
        assert "localize" in script and "policies" in script


RECORDED = ("simulate", "--out", "never", "--data", "canyon28_vehicle")
MISTAKES = {  # name -> words typed, expected message
    "missing scene": (("compare", "--scene", "plaza.json"), "plaza.json"),
    "negative count": (("compare", "--episodes", "-5"), "episodes: found -5, expected at least 1"),
    "JSON to a .tex file": (("compare", "--json", "t.tex"), "json: .* ends with .json"),
    "a table to .txt": (("compare", "--episodes-csv", "t.txt"), "episodes-csv: .* ends with .csv"),
    "scenario of recorded data": ((*RECORDED, "--scenario", "jam"), "scenario: found 'jam', but"),
    "unknown option": (("compare", "--color", "red"), "--color"),
    "mistyped option": (("compare", "--episode=3"), "--episode=3; did you mean --episodes[?]"),
    "a word too many": (("speed", "fast"), "fast"),
    "a word as a number": (("compare", "--seed", "one"), "--seed: found 'one', expected INT"),
    "unknown choice": (("train", "--algo", "pp"), "pp.*--algo.*ppo.*rollouts"),
    "an option without its value": (("compare", "--json"), "--json"),
    "a required option missing": (("simulate",), "--out PATH"),
    "an unsupported risk": (("compare", "--risk", "0.05"), "risk: found 0.05, expected 0.01 or"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_with_one_clear_line(mistake):
    words, message = MISTAKES[mistake]
    assert_refused(f"^mmwave-loc {words[0]}: .*{message}", *words)
    assert not (ROOT / "never").exists()


def test_the_error_about_an_unknown_command_lists_all_names_and_suggests_a_similar_one():
    assert_refused("'fly', expected one of demo, .*compare, tables", "fly")
    assert_refused("'localise', did you mean localize[?] Expected", "localise")


@pytest.mark.slow
@pytest.mark.parametrize("module", ["tyro", "experiments.compare", "numba"])
def test_an_interrupt_at_startup_ends_the_program_with_one_line(module):
    # If a shell runs tests in the background, SIGINT is ignored until signal.signal sets a handler.
    code = (
        "import os, signal, sys\n"
        "from experiments.console.main import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        "sys.argv = ['mmwave-loc', 'compare', '--episodes', '100000']\n"
        "main()\n"
    )
    done = python(code)
    assert (done.returncode, done.stdout) == (130, "")
    assert re.fullmatch("mmwave-loc( compare)?: interrupted\n", done.stderr)


def test_defaults_of_options_equal_the_constants_of_the_library():
    """Compare constants with their copies in options, which --help shows without slow imports."""
    from experiments.evaluation import protocol
    from mmwave_env.filters.smoother import SMOOTHING_WINDOW
    from mmwave_env.interface.reward import TrackingReward
    from mmwave_env.metrics import RISK
    from mmwave_env.rendering.theme import FRAMES_PER_SECOND, SMALLEST

    def options(name):
        return importlib.import_module(f"experiments.{name}").Args

    assert IntegrityArgs.risk == RISK
    assert options("localize").window == SMOOTHING_WINDOW
    watched = options("watch")
    assert (watched.fps, watched.render_size) == (FRAMES_PER_SECOND, SMALLEST)
    assert TaskArgs.nees_weight == TrackingReward.nees_weight
    judged = options("leaderboard")
    assert (judged.episodes, judged.draws) == (protocol.EPISODES, protocol.DRAWS)


@pytest.mark.torch
def test_the_help_of_train_says_the_default_lengths():
    from experiments.training.run import TIMESTEPS

    shown = command("train", "--help").stdout
    assert all(str(steps) in shown for steps in TIMESTEPS.values())


# --- output


def test_a_terminal_that_reports_zero_columns_gets_the_output():
    ours, theirs = pty.openpty()
    done = started("speed", "--help", env=environment() | {"COLUMNS": "0"}, stdout=theirs)
    os.close(theirs)
    done.communicate()
    assert done.returncode == 0 and b"usage" in os.read(ours, 10_000)
    os.close(ours)


def test_a_closed_standard_input_is_an_empty_one():
    words = [sys.executable, "-m", "experiments.console", "localize", "-", "--live"]
    line = f"{shlex.join(words)} --scene street <&-"
    done = subprocess.run(line, shell=True, capture_output=True, text=True, cwd=ROOT)
    assert_one_clear_line(done, "found nothing on standard input")


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="NumPy can't be imported there")
def test_the_error_names_a_deleted_working_folder(tmp_path):
    code = (
        f"import os; os.chdir({str(tmp_path)!r}); os.rmdir({str(tmp_path)!r})\n"
        "import sys; sys.argv = ['mmwave-loc', 'localize', 'log.csv', '--scene', 'scene.json']\n"
        "from experiments.console.main import main\n"
        "main()"
    )
    done = python(code)
    assert_one_clear_line(done, "the working folder|log.csv: found no such file")


def test_quiet_shows_nothing_and_still_writes_the_results(tmp_path):
    options = ("--policies", "fixed-ukf", "imm", "--episodes", 2)
    done = command("compare", *options, "--quiet", "--json", tmp_path / "all.json")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(json_in(tmp_path / "all.json")["policies"]) == ["fixed-ukf", "imm"]
    assert "fixed-ukf" in command("compare", *options).stdout  # later commands are not quiet
    assert_refused("'lab'.*handset", "compare", "--quiet", "--radio", "lab")


def test_a_traceback_is_shown_only_with_the_option_debug(monkeypatch):
    def fails(args):
        raise ZeroDivisionError("by\x1b[31m zero")

    monkeypatch.setattr("experiments.tables.main", fails)
    done = command("tables")
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    failure = r"failed with ZeroDivisionError: by\x1b[31m zero; please report"
    assert line.startswith(f"mmwave-loc tables: {failure}")
    shown = command("tables", "--debug").stderr
    assert shown.startswith("Traceback") and "in fails" in shown
    assert "Traceback" in command("compare", "--debug", "--radio", "lab").stderr


@pytest.mark.parametrize("word", ["lab\x1b]0;owned\x07", "a\nb", "a\u202eb", "\udcff"])
def test_messages_about_mistakes_contain_no_control_characters(word):
    for words in (("compare", "--radio", word), ("compare", "--policies", word), (word,)):
        done = command(*words)
        assert_printable(done)
        assert done.returncode == 2
    assert_refused("--no", "compare", f"--no{word}")
