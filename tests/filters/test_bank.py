"""Tests of writing banks (modes and how they interact) to mode files and reading them back."""

import json

import pytest

from mmwave_env.filters.bank import (
    Bank,
    bank_as_written,
    bank_from,
    bank_in,
    best_bank,
    modes_from,
)
from mmwave_env.filters.modes import Mode
from tests.refusals import refuses

BANK = Bank((Mode("slow", "ckf", sigma_v=0.1 + 0.2), Mode("fast")), ((0.9, 0.1), (0.3, 0.7)), 0.99)


@pytest.mark.parametrize("bank", [BANK, Bank(BANK.modes), best_bank("standard")])
def test_a_bank_read_from_json_equals_the_bank_that_was_written(bank):
    written = bank_as_written(bank)
    assert json.loads(json.dumps(written)) == written  # a resumed training relies on this
    assert bank_in(written) == bank


def test_a_mode_file_defines_the_transition_if_given_alone_or_in_a_list_of_one(tmp_path):
    path = tmp_path / "bank.json"
    path.write_text(json.dumps(bank_as_written(BANK)))
    assert bank_from(path) == bank_from(str(path)) == bank_from([path]) == bank_from((str(path),))
    assert bank_from([path]) == BANK
    assert bank_from([path, "ekf"]).transition is None  # the file says nothing about three modes


def test_the_parsed_content_of_a_mode_file_is_accepted_instead_of_the_file():
    content = bank_as_written(BANK)
    assert bank_from(content) == BANK and modes_from(content) == BANK.modes
    for read in (bank_from, modes_from):
        for wrong, field in (({"mode": content["modes"]}, "key"), ({}, "modes")):
            with refuses(field):
                read(wrong)


@pytest.mark.parametrize("read", [bank_from, modes_from])
@pytest.mark.parametrize(
    ("misspelt", "key"), [("transitions", "transition"), ("nis_quantil", "nis_quantile")]
)
def test_a_misspelt_key_is_refused(tmp_path, read, misspelt, key):
    content = bank_as_written(BANK)
    content[misspelt] = content.pop(key)
    path = tmp_path / "bank.json"
    path.write_text(json.dumps(content))
    with refuses("bank.json", "key"):
        read(path)


@pytest.mark.parametrize("number", [10**400, "p", "1", True, None, [1.0]])
def test_a_transition_with_an_entry_that_is_not_a_finite_number_is_refused(number):
    with refuses("transition"):
        bank_in(bank_as_written(BANK) | {"transition": [[number, 0.1], [0.3, 0.7]]})
