"""Places to train at: how they are named, and what is refused."""

import json

import numpy as np
import pytest

from experiments.evaluation.protocol import UNSEEN_RADIOS, UNSEEN_SCENES, unseen_file
from experiments.training import places as module
from experiments.training.places import Place, place_from, places_from, shares
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES


def test_a_word_names_street_radio_and_rate():
    assert place_from("street:handset") == Place("street", "handset", 1.0)
    assert place_from("o1:standard:0.1") == Place("o1", "standard", 0.1)
    source = place_from("o1:standard:0.1").source("vehicle")
    assert (source.scene, source.radio, source.dt) == (SCENES["o1"], RADIOS["standard"], 0.1)
    assert source.scenario == "vehicle"


@pytest.mark.parametrize("word", ["street:handset", "o1:standard:0.1"])
def test_a_place_is_written_as_it_was_named(word):
    assert str(place_from(word)) == word


def test_the_street_is_where_the_environment_is_without_a_scene():
    """Bit for bit, or trainings on record would not come out again."""
    episode = Place("street", "handset").source("mixed").sample(np.random.default_rng(10_000_000))
    expected = module.task_from().source.sample(np.random.default_rng(10_000_000))
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
    ("words", "message"),
    [
        (["street"], "found 'street', expected SCENE:RADIO or SCENE:RADIO:DT, such as"),
        (["street:"], "found 'street:', expected SCENE"),
        ([":handset"], "found ':handset', expected SCENE"),
        (["street:handset:1:2"], "found 'street:handset:1:2', expected SCENE"),
        (["street:handset:"], "found 'street:handset:', expected SCENE"),
        (["steet:handset"], "steet:handset: scene: found 'steet', did you mean street"),
        (["street:handsome"], "street:handsome: radio: found 'handsome', did you mean handset"),
        (["canyon28_vehicle:handset"], "scene: found 'canyon28_vehicle', expected one of street"),
        (["street:handset:fast"], "street:handset:fast: dt: found 'fast', expected a number"),
        (["street:handset:0"], "street:handset:0: dt: found 0.0, expected a number of 1e-06"),
        (["street:handset:nan"], "dt: found nan, expected a number"),
        (["o1:handset", "street:high", "o1:handset:1"],
         "found o1:handset, street:high, o1:handset, expected none twice"),
    ],
)  # fmt: skip
def test_what_is_no_place_is_refused(words, message):
    with pytest.raises(ValueError, match=f"^places: .*{message}"):
        places_from(words)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere.json: found no such file"):
        place_from(f"{tmp_path}/nowhere.json:handset")


@pytest.mark.parametrize("unseen", ["square", "mine"])
def test_no_training_sees_what_the_benchmark_keeps_unseen(unseen, files, monkeypatch):
    """By the names in the files, whatever these are called."""
    monkeypatch.setattr(module, "UNSEEN", ("square-2", unseen))
    with pytest.raises(ValueError, match=f"^places: .*'{unseen}', .* square-2, {unseen} unseen"):
        place_from(":".join(map(str, files)))
    place_from("street:handset")


def test_the_streets_and_the_radio_that_are_unseen_are_refused():
    for name in UNSEEN_SCENES:
        for word in (f"{name}:handset", f"{unseen_file(name)}:handset"):
            with pytest.raises(ValueError, match=f"scene: found '{name}', expected one to train"):
                place_from(word)
    for name in UNSEEN_RADIOS:
        for word in (f"street:{name}", f"street:{unseen_file(name)}"):
            with pytest.raises(ValueError, match=f"radio: found '{name}', expected one to train"):
                place_from(word)


@pytest.mark.parametrize(("count", "places"), [(256, 9), (9, 9), (500, 3), (7, 1)])
def test_shares_are_as_even_as_can_be(count, places):
    found = shares(count, places)
    assert sum(found) == count and len(found) == places
    assert max(found) - min(found) <= 1
