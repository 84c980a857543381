"""What is learned at several places: what differs between them, and what may not."""

import json
from dataclasses import replace

import pytest

from experiments.training.places import Place, places_from
from experiments.training.training_task import TrainingTask, banks_of
from mmwave_env.filters.bank import Bank, bank_as_written, best_bank
from mmwave_env.filters.mode_files import default_modes
from mmwave_env.reward import TrackingReward
from mmwave_env.task import task_from
from tests.training.actors import MODES

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
    message = r"places: found \d+ features at street:handset and \d+ others at .*square.json:hand"
    with pytest.raises(ValueError, match=message):
        task(places)


def test_an_agent_chooses_from_modes_of_the_same_names_everywhere():
    banks = {"handset": Bank(MODES), "standard": Bank(MODES[::-1])}
    with pytest.raises(ValueError, match="expected the same everywhere: .* modes of the same name"):
        task(banks=banks)


def test_one_mode_alone_is_nothing_to_trust():
    with pytest.raises(ValueError, match="modes: found 'ukf' alone, expected two or more"):
        banks_of(("ukf",), PLACES, "per-mode")
