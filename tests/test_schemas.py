"""Tests that the JSON schemas of users' files agree with the readers of these files."""

import json
from dataclasses import asdict

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from mmwave_env.filters.bank import bank_as_written, best_bank, read_bank
from mmwave_env.logs.live_log import LiveLog
from mmwave_env.models.radio import read_radio
from mmwave_env.models.scene import read_scene
from mmwave_env.world.mobility import MOBILITIES, read_mobility
from tests.damage import changed
from tests.paths import RIDE, ROOT, json_in, records, write_json
from tests.schemas import path_of, schemas

READERS = {"scene": read_scene, "radio": read_radio, "modes": read_bank, "mobility": read_mobility}
DRIVING = MOBILITIES["vehicle"].phases[0].limits
SCHEMAS = schemas()
VALIDATORS = {name: Draft202012Validator(schema) for name, schema in SCHEMAS.items()}

every_file = pytest.mark.parametrize("name", READERS)


EXAMPLES = {  # contents of files
    "scene": json_in(RIDE / "scene.json"),
    "radio": {"base": "handset", "aoa_floor_deg": 2.0, "range_floor_m": [0.5, 1.0]},
    "modes": bank_as_written(best_bank("handset")),
    "mobility": {
        "phases": [
            {"limits": asdict(DRIVING), "gaits": [{"low_mps": 3, "high_mps": 7}]} | phase
            for phase in ({"duration_s": [10, 20]}, {})
        ],
        "blocks": 2,
    },
}


def refusal(name, content, folder):
    """Return the error's text ("" unless it names file and schema), or None if the file is read."""
    path = write_json(folder / f"{name}.json", content)
    try:
        READERS[name](path)
    except ValueError as error:
        schema = path_of(name).relative_to(ROOT).as_posix()
        return str(error) if str(path) in str(error) and schema in str(error) else ""
    return None


@every_file
def test_the_shipped_schema_agrees_with_the_dataclass(name):
    shipped = json_in(path_of(name))
    assert shipped == SCHEMAS[name], "run make generated after changing a dataclass"
    Draft202012Validator.check_schema(shipped)


@every_file
def test_an_example_is_accepted_by_schema_and_reader(name, tmp_path):
    VALIDATORS[name].validate(json.loads(json.dumps(EXAMPLES[name])))
    assert refusal(name, EXAMPLES[name], tmp_path) is None


@every_file
@settings(max_examples=40)
@given(data=st.data())
def test_readers_refuse_what_the_schema_refuses(name, data, tmp_path_factory):
    content = data.draw(changed(EXAMPLES[name]) | changed(EXAMPLES[name] | {"color": 1}))
    if not VALIDATORS[name].is_valid(content):
        assert refusal(name, content, tmp_path_factory.getbasetemp())


LIMITED = [name for name, part in SCHEMAS["log"]["properties"].items() if "maximum" in part]


@pytest.mark.parametrize("name", LIMITED)
def test_a_value_beyond_the_limit_of_its_column_is_refused_by_schema_and_reader(name):
    row = {"time_s": 0.0, "anchor": 1, "range_m": 20.0, "snr_db": 20.0}
    stem = name.rpartition("_")[0]
    if stem in ("toa", "rtt", "rstd", "range") or name == "snr_db":
        row = {"time_s": 0.0, "anchor": 1, "aoa_azimuth_rad": 0.1, "snr_db": 20.0}
    elif stem in ("speed", "heading", "aod_azimuth_body"):
        row |= {"heading_rad": 0.1, "speed_mps": 1.0}
    row = {column: value for column, value in row.items() if not column.startswith(f"{stem}_")}
    limit = SCHEMAS["log"]["properties"][name]["maximum"]
    for factor in (0.99, 1.01):
        line = row | {name: factor * limit}
        scene = read_scene(RIDE / "scene.json")
        log = LiveLog(list(line), scene, clock="free" if stem == "rstd" else "synchronized")
        log.add(line)
        assert (not log.left_out) == VALIDATORS["log"].is_valid(line) == (factor < 1.0)


def test_rows_of_the_shipped_log_satisfy_the_schema():
    for row in records(RIDE / "log.csv"):
        numbers = {name: float(cell) if cell else None for name, cell in row.items()}
        VALIDATORS["log"].validate(numbers | {"anchor": int(row["anchor"])})
    assert not VALIDATORS["log"].is_valid({"time_s": 0.0, "anchor": 1, "snr_db": 10.0})
