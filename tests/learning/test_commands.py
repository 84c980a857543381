"""`transfer`, `ablate` and `learned` as a user types them."""

import json
import re

import numpy as np
import pytest

from experiments.evaluation.contenders import contender_from
from experiments.evaluation.runner import score
from experiments.evaluation.runs import Run
from experiments.evaluation.seeds import draw_episodes
from experiments.learning import learned
from experiments.learning.curves import curve, draw_curves
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT

RECORDED = ROOT / "docs" / "learning"


@pytest.mark.slow
def test_transfer_meets_the_rivals_of_each_place(tmp_path):
    file = tmp_path / "transfer.json"
    done = command("transfer", "--policies", "ppo", "--episodes", 3, "--draws", 2, "--json", file)
    assert done.returncode == 0, done.stderr
    places = json.loads(file.read_text())["places"]
    streets = {f"{scene}, handset" for scene in SCENES}
    radios = {f"street, {radio}" for radio in RADIOS}
    recordings = {"canyon28_pedestrian, handset", "canyon28_vehicle, handset"}
    assert set(places) == streets | radios | recordings
    assert len(done.stdout.splitlines()) == 2 + len(places)
    source = SimulatedSource(SCENES["street"], RADIOS["high"], "mixed")
    episodes = draw_episodes(source, range(3))
    earned = {}
    for name, contender in (
        ("ppo", contender_from("ppo-handset", "handset")), ("imm", contender_from("imm", "high")),
    ):  # fmt: skip
        earned[name] = score(contender, contender.start(source.layout), episodes)["reward"]
    found = places["street, high"]["ppo minus imm"]["mean"]
    assert found == pytest.approx((earned["ppo"] - earned["imm"]).mean(), abs=1e-9)


@pytest.mark.slow
def test_transfer_shows_on_a_terminal_how_far_it_is(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as if it were one
    done = command("transfer", "--policies", "fixed-ukf", "--episodes", 1, "--draws", 1)
    assert done.returncode == 0 and "100%" in done.stderr


def test_an_unknown_policy_is_one_line():
    done = command("transfer", "--policies", "oracle", "--episodes", 1, "--draws", 1)
    assert done.returncode == 2
    assert "policy: found 'oracle', expected one of" in done.stderr.strip().splitlines()[-1]


def test_learned_needs_recorded_runs(tmp_path):
    done = command("learned", "--runs", tmp_path, "--episodes", 20, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "ppo-handset" in done.stderr and "found no file" in done.stderr


def test_the_help_names_every_recorded_run():
    said = " ".join(succeed("learned", "--help").split())
    named = said.split("folder of the recorded runs: ")[1].split("--episodes")[0]
    runs = [path.name for path in RECORDED.iterdir() if path.is_dir()]
    assert {re.sub("-(handset|standard)$", "-RADIO", run) for run in runs} <= set(
        re.findall(r"[\w-]+", named)
    )


def test_figures_say_how_to_make_them_again(tmp_path, monkeypatch):
    table = ("trainings", "| run |", {"seeds": 5})
    monkeypatch.setattr(learned, "tables", lambda args: iter([table]))
    file = tmp_path / "all.json"
    learned.main(learned.Args(episodes=20, json=file, out=tmp_path))
    found = json.loads(file.read_text())
    assert found["command"] == "mmwave-loc learned --episodes 20"
    assert "numba" in found["versions"] and found["trainings"] == {"seeds": 5}


def test_learned_refuses_too_few_episodes_at_once(tmp_path):
    done = command("learned", "--runs", tmp_path, "--episodes", 19, "--out", tmp_path / "out")
    assert_one_clear_line(done, "episodes: found 19, expected at least 20")


def test_curves_are_those_of_the_journals(tmp_path):
    run = RECORDED / "ppo-handset"
    steps, gain = curve(run / "seed-0" / "progress.csv", "tuning/minus speed-rule")
    assert len(steps) == len(gain) > 5 and (np.diff(steps) > 0).all()
    assert gain[-1] > 0.2  # the rule is beaten
    draw_curves([run], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.torch
def test_an_ablation_is_a_run_a_variant(tmp_path):
    pytest.importorskip("stable_baselines3")
    out = tmp_path / "ablation"
    options = ["--variants", "as-shipped", "one-tuning", "four-frames", "--seeds", 1]
    done = command("ablate", *options, "--total-timesteps", 16384, "--out", out)
    assert done.returncode == 0, done.stderr
    for name in ("as-shipped", "one-tuning", "four-frames"):
        assert Run.read(str(out / name)).seeds == (0,)
    frames = json.loads((out / "four-frames" / "run.json").read_text())["recipe"]["frames"]
    assert frames == 4
    low, high = json.loads((out / "one-tuning" / "run.json").read_text())["modes"]
    assert low["sigma_v"] == high["sigma_v"] and low["algorithm"] != high["algorithm"]
    refused = command("ablate", "--variants", "everything", "--out", out)
    assert refused.returncode == 2 and "found 'everything', expected one of" in refused.stderr
