"""Places to train at: how they are named, what differs between them, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.evaluation.protocol import UNSEEN_RADIOS, UNSEEN_SCENES, unseen_file
from experiments.training import training_task as module
from experiments.training.training_task import (
    Place,
    TrainingTask,
    banks_of,
    place_from,
    places_from,
    shares,
)
from mmwave_env.filters.bank import Bank, bank_as_written, best_bank, default_modes
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from tests.refusals import refuses
from tests.training.actors import MODES


def test_a_word_names_street_radio_and_rate():
    assert place_from("street:handset") == Place("street", "handset", 1.0)
    assert place_from("o1:standard:0.1") == Place("o1", "standard", 0.1)
    assert str(place_from("o1:standard:0.1")) == "o1:standard:0.1"
    source = place_from("o1:standard:0.1").source("vehicle")
    assert (source.scene, source.radio, source.dt) == (SCENES["o1"], RADIOS["standard"], 0.1)
    assert source.scenario == "vehicle"


def test_the_street_is_where_the_environment_is_without_a_scene():
    """Bit for bit, or trainings on record would not come out again."""
    episode = Place("street", "handset").source("mixed").sample(np.random.default_rng(10_000_000))
    expected = task_from().source.sample(np.random.default_rng(10_000_000))
    np.testing.assert_array_equal(episode.measurement, expected.measurement)


@pytest.fixture
def files(tmp_path):
    """A scene and a radio of one's own."""
    scene, radio = tmp_path / "square.json", tmp_path / "phone.json"
    scene.write_text(json.dumps({"base_station_m": [10.0, 10.0, 8.0]}))
    radio.write_text(json.dumps({"name": "mine", "base": "handset"}))
    return scene, radio


def test_scenes_and_radios_of_ones_own_are_places_too(files):
    place = place_from(":".join(map(str, files)))
    assert place.profile == "mine" and place.source("mixed").scene.name == "square"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["street"], []),
        ([":handset"], []),
        (["street:handset:1:2"], []),
        (["steet:handset"], ["steet:handset", "scene"]),
        (["street:handsome"], ["street:handsome", "radio"]),
        (["street:handset:fast"], []),
        (["street:handset:nan"], ["street:handset:nan", "dt"]),
        (["o1:handset", "street:high", "o1:handset:1"], []),
    ],
)
def test_what_is_no_place_is_refused(words, named):
    with refuses("places", *named):
        places_from(words)


@pytest.mark.parametrize("unseen", ["square", "mine"])
def test_no_training_sees_what_the_benchmark_keeps_unseen(unseen, files, monkeypatch):
    """The names in the files count, whatever these are called."""
    monkeypatch.setattr(module, "UNSEEN", ("square-2", unseen))
    with refuses("places"):
        place_from(":".join(map(str, files)))
    place_from("street:handset")


def test_the_streets_and_the_radio_that_are_unseen_are_refused():
    for name in UNSEEN_SCENES:
        for word in (f"{name}:handset", f"{unseen_file(name)}:handset"):
            with refuses("scene"):
                place_from(word)
    for name in UNSEEN_RADIOS:
        for word in (f"street:{name}", f"street:{unseen_file(name)}"):
            with refuses("radio"):
                place_from(word)


@pytest.mark.parametrize(("count", "places"), [(256, 9), (9, 9), (500, 3), (7, 1)])
def test_shares_are_as_even_as_can_be(count, places):
    parts = shares(count, places)
    assert sum(parts) == count and len(parts) == places
    assert max(parts) - min(parts) <= 1


# --- what is learned at several places

PLACES = places_from(["street:handset", "o1:standard", "street:standard:0.5"])


def task(places=PLACES, banks=None, beliefs="per-mode"):
    banks = banks_of((), places, beliefs) if banks is None else banks
    return TrainingTask("mixed", places, banks, "full", TrackingReward(), beliefs)


def test_every_place_has_the_bank_of_its_radio():
    assert task().banks == {radio: best_bank(radio) for radio in ("handset", "standard")}
    at = task_from(**task().arguments(PLACES[1]))
    assert at.bank == best_bank("standard") and at.source == PLACES[1].source("mixed")


def test_modes_that_share_a_belief_are_the_same_everywhere():
    """Those of the first place's radio: a policy file brings them along."""
    shared = task(beliefs="shared")
    assert {bank.modes for bank in shared.banks.values()} == {default_modes("handset")}
    at = task_from(**shared.arguments(PLACES[1]))
    assert at.bank is None and at.pipeline.modes == default_modes("handset")


def test_a_bank_of_ones_own_is_used_everywhere(tmp_path):
    own = replace(best_bank("high"), nis_quantile=0.9)
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(bank_as_written(own)))
    assert banks_of((str(path),), PLACES, "per-mode") == {"handset": own, "standard": own}


def test_an_agent_sees_the_same_features_everywhere(tmp_path):
    path = tmp_path / "square.json"
    path.write_text(json.dumps({"base_station_m": [10.0, 10.0, 8.0]}))  # no walls
    places = (PLACES[0], Place(str(path), "handset"))
    with refuses("places"):
        task(places)


def test_an_agent_chooses_from_modes_of_the_same_names_everywhere():
    banks = {"handset": Bank(MODES), "standard": Bank(MODES[::-1])}
    with refuses("places"):
        task(banks=banks)


def test_one_mode_alone_is_nothing_to_trust():
    with refuses("modes"):
        banks_of(("ukf",), PLACES, "per-mode")
