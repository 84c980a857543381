"""Tests of running contenders (policies with their modes, or IMMs), and of their histories."""

import json
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mmwave_env  # noqa: F401  registers the environment
from experiments.evaluation import contenders as contenders_module
from experiments.evaluation import runner as evaluation
from experiments.evaluation.contenders import (
    Contender,
    Run,
    contender_from,
    contenders,
    draw_episodes,
)
from experiments.evaluation.runner import (
    Scoring,
    history_of,
    run_contender,
    score,
    score_contenders,
)
from mmwave_env.datasets.recorded import TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.filters.bank import bank_as_written, modes_from
from mmwave_env.interface.observation import BELIEFS
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.metrics import BURN_IN, INFO_KEYS, METRICS
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import SCENES
from mmwave_env.rendering.history import NO_MODE
from policies import LearnedSwitch, learned, shipped_policies
from tests.filters.tracks import nees_of, street_source
from tests.paths import ROOT, write_json
from tests.policies.test_corrector import card, network
from tests.refusals import refuses
from tests.training.actors import HANDSET, MODES, STANDARD, actor, card_of, write, write_per_mode

# The speed rule warns if a lost track seems too fast; another test checks this warning.
pytestmark = pytest.mark.filterwarnings("ignore:speed .* outside the design window")

SOURCE = street_source()


def assert_equal(scores, expected):
    assert scores.keys() == expected.keys()
    for name, rows in scores.items():
        for metric in METRICS:
            assert_array_equal(rows[metric], expected[name][metric])


@pytest.mark.parametrize("beliefs", BELIEFS)
def test_scores_equal_the_results_of_stepping_a_single_environment(beliefs, per_mode):
    contender = Contender.learned(per_mode, "mine", "handset")
    if beliefs == "shared":
        contender = contender_from("speed-rule", "handset")
    taken = []
    watch = [lambda _, episodes, results: taken.extend(results["mode"].tolist())]
    seeds = range(2)
    source = replace(SOURCE, dt=0.5)
    (scores,) = score_contenders([contender], source, seeds, watch=watch).values()
    assert set(scores) == {*METRICS, "error_term", "nees_term"}
    env = gym.make("MmWaveLoc-v0", dt=0.5, beliefs=beliefs, modes=contender.filters)
    for e in range(2):
        policy = contender.policy(env.unwrapped.observation)
        observation, _ = env.reset(seed=e)
        rewards = []
        actions = []
        over = False
        while not over:
            (action,) = policy.act(observation[None])
            observation, reward, _, over, info = env.step(action)
            rewards.append(reward)
            actions.append(info["mode"])
        expected = {metric: info[key] for metric, key in INFO_KEYS.items()}
        expected["reward"] = np.mean(rewards[BURN_IN:])
        assert {m: scores[m][e] for m in expected} == pytest.approx(expected, rel=1e-12)
        terms = scores["error_term"][e] + scores["nees_term"][e]
        assert -terms == pytest.approx(expected["reward"], rel=1e-9)
        assert taken[e] == actions
    assert np.max(taken) == len(contender.actions) - 1  # even the last mode was used


def test_scores_depend_neither_on_the_chunk_size_nor_on_other_seeds_or_contenders(monkeypatch):
    both = [contender_from(name, "handset") for name in ("fixed-ekf", "fixed-ukf")]
    whole = score_contenders(both, SOURCE, range(5))
    monkeypatch.setattr(evaluation, "CHUNK", 2)
    assert_equal(score_contenders(both, SOURCE, range(5)), whole)
    alone = score_contenders(both[1:], SOURCE, range(3, 5))
    last = {metric: values[3:] for metric, values in whole["fixed-ukf"].items()}
    assert_equal(alone, {"fixed-ukf": last})
    assert (whole["fixed-ekf"]["ate_m"] != whole["fixed-ukf"]["ate_m"]).all()


def test_episodes_without_truth_are_refused():
    (episode,) = draw_episodes(SOURCE, [0])
    blind = replace(episode, truth_position_m=None, truth_velocity_mps=None)
    contender = contender_from("fixed-ekf", "handset")
    with pytest.raises(ValueError, match="found no truth"):
        score(contender, [blind])


def test_custom_modes_determine_the_contenders():
    modes = modes_from(["ekf", "ckf", "ukf-robust"])
    makes = contenders("handset", modes)
    fixed = [f"fixed-{mode.name}" for mode in modes]
    assert list(makes) == [*fixed, "likelihood-rule", "imm"]
    assert all(make().modes == modes for make in makes.values())
    assert "speed-rule" in contenders("handset", modes[:2])


# --- learned contenders


@pytest.fixture
def file(tmp_path):
    """Return the file of a policy for the handset and three modes."""
    return write(tmp_path / "ppo-handset.safetensors", actor(), card_of())


@pytest.fixture
def ship(monkeypatch):
    """Return a function that replaces the shipped policies by others."""

    def replace_by(policies):
        for module in (contenders_module, learned):
            monkeypatch.setattr(module, "shipped_policies", lambda: policies)

    return replace_by


def test_shipped_policies_are_contenders_of_their_radio(file, ship):
    ship({"ppo-handset": file})
    assert list(contenders("handset"))[-1] == "ppo" and "ppo" not in contenders("standard")
    assert "ppo" not in contenders("handset", MODES)  # ppo has its own modes
    assert contender_from("ppo", "handset").modes == MODES
    assert "guided" not in contenders("handset")
    named = contender_from("ppo-handset", "standard")
    assert named.name == "ppo-handset" and named.modes == MODES
    with refuses("policy"):
        contender_from("ppo-high", "high")


def test_a_policy_for_all_radios_is_a_contender_with_the_bank_of_each_radio(file, ship, per_mode):
    ship({"ppo-handset": file, "guided": per_mode, "guided-standard": file})
    for radio, modes in {"handset": HANDSET.modes, "high": STANDARD.modes}.items():
        guided = contenders(radio)["guided"]()
        assert (guided.name, guided.modes, guided.beliefs) == ("guided", modes, "per-mode")
    assert contenders("standard")["guided"]().beliefs == "shared"  # the radio's own policy
    assert list(contenders("high"))[-2:] == ["imm-best", "guided"]
    assert contender_from("guided", "high", MODES).bank == STANDARD  # MODES is ignored


# --- beliefs per mode


@pytest.fixture
def per_mode(tmp_path):
    """Return the file of a policy with beliefs "per-mode": every mode keeps its own belief."""
    return write_per_mode(tmp_path / "per_mode.safetensors")


def test_the_imm_always_uses_the_transition_matrix_of_a_bank_or_bank_file(tmp_path):
    path = write_json(tmp_path / "bank.json", bank_as_written(HANDSET))
    for modes in (HANDSET, path, str(path), (str(path),)):
        for beliefs in BELIEFS:
            imm = contender_from("imm", "handset", modes, beliefs=beliefs)
            assert imm == Contender(HANDSET, name="imm")
    assert contender_from("fixed-walk", "handset", path).modes == HANDSET.modes


# --- correctors

IMM = Contender(HANDSET, name="imm")


@pytest.fixture(scope="module")
def short():
    """Return four episodes of 60 epochs."""
    return replace(SOURCE, epochs=60).episodes(np.arange(4, dtype=np.uint64))


def corrector(folder, tensors):
    return Contender.learned(write(folder / "mine.safetensors", tensors, card()), "mine", "handset")


@pytest.mark.slow
def test_a_corrector_that_corrects_nothing_has_the_scores_of_its_imm(tmp_path, short):
    tensors = network()
    tensors["out.weight"][:] = 0.0
    tensors["out.bias"][:] = 0.0
    mine = corrector(tmp_path, tensors)
    ours = score(mine, short)
    theirs = score(IMM, short)
    for metric, values in theirs.items():
        assert_allclose(ours[metric], values, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_errors_and_nees_belong_to_the_corrected_beliefs(tmp_path, short):
    mine = corrector(tmp_path, network(limit=50.0))
    results = run_contender(mine, short, after=("x", "P"))
    plain = run_contender(IMM, short)
    truth = np.stack([episode.truth_position_m for episode in short])
    error = results["x"][..., :3] - truth
    assert_allclose(results["error"], error, atol=1e-9)
    nees = nees_of(error, results["P"])
    assert_allclose(results["nees"], nees, rtol=1e-6)
    length = np.minimum(np.linalg.norm(error, axis=-1), 10.0)
    odd = np.minimum(np.abs(np.log(np.maximum(nees, 1e-12) / 3.0)), 3.0)
    assert_allclose(results["reward"], -length - 0.2 * odd, atol=1e-6)
    assert (results["error"] != plain["error"]).any(axis=-1).mean() > 0.9


# --- folders of training runs, whose policies are contenders

DAMAGE = {  # name -> content of a summary, keys that the error names
    "not JSON": ("{", []),
    "no seeds": ({"median": 0}, ["seeds"]),
    "no median": ({"seeds": [{"seed": 0}]}, ["median"]),
    "empty seeds": ({"seeds": [], "median": 0}, ["seeds"]),
    "a seed twice": ({"seeds": [{"seed": 0}] * 2, "median": 0}, ["seeds"]),
    "unknown median": ({"seeds": [{"seed": 0}], "median": 7}, ["median"]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_the_error_names_a_damaged_summary(tmp_path, damage):
    content, named = DAMAGE[damage]
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / "summary.json").write_text(text)
    with refuses(tmp_path / "summary.json", *named):
        Run.read(str(tmp_path))


@pytest.mark.parametrize("name", ["guided", "guided-ppo", "ppo-handset", "ppo-standard"])
def test_a_shipped_policy_is_the_median_of_its_five_training_seeds(name):
    folder = str(ROOT / "docs" / "learning" / name)
    run = Run.read(folder)
    shipped = shipped_policies()[name]
    assert len(run.policies) == 5 and run.policy == run.policies[2]
    assert shipped.read_bytes() == Path(run.policy).read_bytes()
    cards = [LearnedSwitch(path).card for path in run.policies]
    assert [f"seed-{card.seed}" for card in cards] == [Path(p).parent.name for p in run.policies]
    assert all(card.evaluation["seed"] >= 5_000_000 for card in cards)  # none is a test seed
    rewards = [card.evaluation["reward"] for card in cards]
    assert rewards == sorted(rewards, reverse=True)
    played = contender_from(folder, "standard" if name == "ppo-standard" else "handset")
    assert played.start(Layout()).card.seed == cards[2].seed


# --- histories (the data of pictures), which equal those of an environment

SEED = 5
(EPISODE,) = draw_episodes(SOURCE, [SEED])


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("speed-rule", {}),
        # The next two cases are slow, because each compiles its own kernels.
        pytest.param("fixed-ukf", {"planar": True}, marks=pytest.mark.slow),
        pytest.param("guided", {"beliefs": "per-mode"}, marks=pytest.mark.slow),
    ],
)
def test_a_history_equals_what_an_environment_records(name, arguments):
    pytest.importorskip("pygame")
    scoring = Scoring(TrackingReward(), arguments.get("planar", False))
    contender = contender_from(name, "handset")
    history = history_of(contender, EPISODE, scoring, SCENES["street"])
    arguments |= {"modes": contender.filters, "render_mode": "rgb_array"}
    env = gym.make("MmWaveLoc-v0", **arguments).unwrapped
    env.reset(seed=SEED)
    for mode in history.modes[1:]:
        env.step(mode)
    recorded = env._gallery.history(0)
    assert history.axes == recorded.axes and history.epochs == recorded.epochs == len(EPISODE)
    assert history.name == recorded.name
    assert history.scene == recorded.scene is not None
    assert_array_equal(history.anchors_m, recorded.anchors_m)
    for field in ("time_s", "modes", "truth", "estimate", "P", "nees", "accepted", "rejected"):
        assert_allclose(
            getattr(history, field), getattr(recorded, field), err_msg=field, rtol=1e-9, atol=1e-9
        )


def test_the_history_of_an_imm_shows_the_most_probable_modes():
    contender = contender_from("imm", "handset")
    history = history_of(contender, EPISODE)
    assert history.modes[0] == NO_MODE
    assert set(history.modes[1:]) == set(range(len(contender.actions)))
    assert (history.accepted[1:] | history.rejected[1:]).any()


def test_the_history_of_a_recording_begins_at_its_prior():
    (episode,) = draw_episodes(TrackSource(read_track("canyon28_pedestrian"), "handset"), [0])
    history = history_of(contender_from("fixed-ukf", "handset"), episode)
    assert_array_equal(history.estimate[0], episode.prior_mean)
    assert history.scene is None and history.time_s[0] == history.time_s[1] == 0.0
    assert history.time_s[-1] == episode.time_s[-1] - episode.time_s[0]
