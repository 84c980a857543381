"""Tests of places of training (scene, radio, time step), and of the modes at each place."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.evaluation.protocol import UNSEEN_RADIOS, UNSEEN_SCENES, name_or_file
from experiments.training import training_task as module
from experiments.training.training_task import (
    Place,
    TrainingTask,
    banks_of,
    place_from,
    places_from,
)
from mmwave_env.filters.bank import Bank, bank_as_written, best_bank, default_modes
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from tests.paths import write_json
from tests.refusals import refuses
from tests.training.actors import MODES


def test_a_word_names_the_scene_the_radio_and_the_time_step():
    assert place_from("street:handset") == Place("street", "handset", 1.0)
    assert place_from("o1:standard:0.1") == Place("o1", "standard", 0.1)
    source = place_from("o1:standard:0.1").source("vehicle")
    assert (source.scene, source.radio, source.dt) == (SCENES["o1"], RADIOS["standard"], 0.1)
    assert source.scenario == "vehicle"


def test_the_street_is_the_default_scene_of_environments():
    """Compare all bits, because it must be possible to repeat published training runs."""
    episode = Place("street", "handset").source("mixed").sample(np.random.default_rng(10_000_000))
    expected = task_from().source.sample(np.random.default_rng(10_000_000))
    np.testing.assert_array_equal(episode.measurement, expected.measurement)


@pytest.fixture
def files(tmp_path):
    """Return the files of a custom scene and a custom radio."""
    scene = write_json(tmp_path / "square.json", {"base_station_m": [10.0, 10.0, 8.0]})
    return scene, write_json(tmp_path / "phone.json", {"name": "mine", "base": "handset"})


def test_custom_scenes_and_radios_can_be_places(files):
    place = place_from(":".join(map(str, files)))
    assert place.profile == "mine" and place.source("mixed").scene.name == "square"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["street"], []),
        (["street:handset:1:2"], []),
        (["steet:handset"], ["steet:handset", "scene"]),
        (["street:handsome"], ["street:handsome", "radio"]),
        (["street:handset:nan"], ["street:handset:nan", "dt"]),
        (["street:handset:fast"], []),
        (["street:handset:-1"], ["street:handset:-1", "dt"]),
        (["o1:handset", "street:high", "o1:handset:1"], []),
    ],
)
def test_words_that_are_not_places_are_refused(words, named):
    with refuses("places", *named):
        places_from(words)


@pytest.mark.parametrize("unseen", ["square", "mine"])
def test_custom_files_named_like_an_unseen_scene_or_radio_are_refused(unseen, files, monkeypatch):
    """Use a radio whose file contains its name, and a scene named after its file."""
    monkeypatch.setattr(module, "UNSEEN", ("square-2", unseen))
    with refuses("places"):
        place_from(":".join(map(str, files)))
    place_from("street:handset")


def test_scenes_and_radios_that_the_benchmark_keeps_unseen_are_refused():
    for name in UNSEEN_SCENES:
        for word in (f"{name}:handset", f"{name_or_file(name)}:handset"):
            with refuses("scene"):
                place_from(word)
    for name in UNSEEN_RADIOS:
        for word in (f"street:{name}", f"street:{name_or_file(name)}"):
            with refuses("radio"):
                place_from(word)


PLACES = places_from(["street:handset", "o1:standard", "street:standard:0.5"])


def task(places=PLACES, banks=None, beliefs="per-mode"):
    banks = banks_of((), places, beliefs) if banks is None else banks
    return TrainingTask("mixed", places, banks, "full", TrackingReward(), beliefs)


def test_every_place_has_the_bank_of_its_radio():
    assert task().banks == {radio: best_bank(radio) for radio in ("handset", "standard")}
    at = task_from(**task().arguments(PLACES[1]))
    assert at.bank == best_bank("standard") and at.source == PLACES[1].source("mixed")


def test_modes_that_share_a_belief_are_the_same_at_all_places():
    """Check that all places use the modes that were tuned for the radio of the first place."""
    shared = task(beliefs="shared")
    assert {bank.modes for bank in shared.banks.values()} == {default_modes("handset")}
    at = task_from(**shared.arguments(PLACES[1]))
    assert at.bank is None and at.pipeline.modes == default_modes("handset")


def test_a_custom_bank_is_used_at_all_places(tmp_path):
    own = replace(best_bank("high"), nis_quantile=0.9)
    path = write_json(tmp_path / "mine.json", bank_as_written(own))
    assert banks_of((str(path),), PLACES, "per-mode") == {"handset": own, "standard": own}


def test_places_with_different_features_or_names_of_modes_are_refused(files):
    square, _ = files  # without walls, a scene has fewer anchors than the street
    with refuses("places"):
        task((PLACES[0], Place(str(square), "handset")))
    with refuses("places"):
        task(banks={"handset": Bank(MODES), "standard": Bank(MODES[::-1])})


def test_beliefs_per_mode_with_a_single_mode_are_refused():
    with refuses("modes"):
        banks_of(("ukf",), PLACES, "per-mode")
