"""Tests that the JSON schemas of users' files agree with the readers of these files."""

import csv
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from mmwave_env.filters.bank import read_bank
from mmwave_env.logs.live_log import LiveLog
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.radio import read_radio
from mmwave_env.models.scene import read_scene
from mmwave_env.world.mobility import read_mobility
from tests.damage import changed
from tests.paths import LOGS, ROOT, json_in
from tests.schemas import path_of, schemas

READERS = {"scene": read_scene, "radio": read_radio, "modes": read_bank, "mobility": read_mobility}
SCHEMAS = schemas()
VALIDATORS = {name: Draft202012Validator(schema) for name, schema in SCHEMAS.items()}

every_file = pytest.mark.parametrize("name", READERS)


def values(schema):
    """Return a strategy for values that a schema accepts."""
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return st.one_of(*map(values, schema[key]))
    if "type" not in schema:  # a note, which readers ignore
        return st.none() | st.text()
    kind = schema["type"]
    if kind == "object":
        parts = {key: values(part) for key, part in schema["properties"].items()}
        needed = {key: parts.pop(key) for key in schema["required"]}
        return st.fixed_dictionaries(needed, optional=parts)
    if kind == "array":
        least = schema.get("minItems", 0)
        most = min(schema.get("maxItems", 3), 3)
        return st.lists(values(schema["items"]), min_size=least, max_size=most)
    if "maxLength" in schema:
        printable = st.characters().filter(str.isprintable)
        return st.text(printable, min_size=1, max_size=schema["maxLength"])
    low = schema.get("exclusiveMinimum", schema.get("minimum", -1e6))
    high = schema.get("exclusiveMaximum", schema.get("maximum", max(2.0 * low, 1e6)))
    ends = {
        f"exclude_{end}": f"exclusive{end.capitalize()}imum" in schema for end in ("min", "max")
    }
    if kind == "number":
        return st.floats(low, high, allow_subnormal=False, **ends)
    if kind == "integer":
        return st.integers(int(low) if abs(low) < 1e6 else 0, 1000)
    return {"string": st.text(), "boolean": st.booleans(), "null": st.none()}[kind]


def consistent(content):
    """Return the content without those contradictions that a schema cannot exclude."""
    if isinstance(content, list):
        pair = len(content) == 2 and all(isinstance(v, float) for v in content)
        return sorted(content) if pair else [*map(consistent, content)]
    if not isinstance(content, dict):
        return content
    content = {key: consistent(value) for key, value in content.items()}
    for i, mode in enumerate(content.get("modes", [])):
        mode["name"] = f"mode {i}"
    if "low_mps" in content:
        content["high_mps"] = content["low_mps"]
    if "normal" in content:
        content["normal"] = [0.6, -0.8]
    for part in content.get("phases", []):
        part["duration_s"] = [10.0, 20.0]
    if "phases" in content and not content.get("ends_as_it_began"):
        del content["phases"][-1]["duration_s"]
    if content.get("transition") is not None:
        modes = len(content["modes"])
        content["transition"] = [[1.0 / modes] * modes] * modes
    for key in ("x_m", "y_m", "block_m"):
        content.pop(key, None)
    both = [key for key in content if key.removesuffix("_deg") + "_rad" in content]
    return {key: value for key, value in content.items() if not (both and key.endswith("_deg"))}


def files(name):
    """Return a strategy for contents of files that the schema accepts."""
    return values(SCHEMAS[name]).map(consistent)


@st.composite
def damaged(draw, name):
    """Draw the content of a file with parts dropped or replaced, or with an unknown key."""
    content = draw(files(name))
    return content | {"color": 1} if draw(st.booleans()) else draw(changed(content))


def refusal(name, content, folder):
    """Return the error's text ("" unless it names file and schema), or None if the file is read."""
    path = folder / f"{name}.json"
    path.write_text(json.dumps(content), encoding="utf-8")
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
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_readers_accept_what_the_schema_accepts(name, data, tmp_path_factory):
    content = data.draw(files(name))
    assert not list(VALIDATORS[name].iter_errors(content))
    assert refusal(name, content, tmp_path_factory.getbasetemp()) is None


@every_file
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_readers_refuse_what_the_schema_refuses(name, data, tmp_path_factory):
    content = data.draw(damaged(name))
    if not VALIDATORS[name].is_valid(content):
        assert refusal(name, content, tmp_path_factory.getbasetemp())


LIMITED = [name for name, part in SCHEMAS["log"]["properties"].items() if "maximum" in part]


@pytest.mark.parametrize("name", LIMITED)
def test_a_row_beyond_the_limit_of_a_column_is_refused_by_schema_and_reader(name):
    row = {"time_s": 0.0, "anchor": 1, "range_m": 20.0, "snr_db": 20.0}
    stem = name.rpartition("_")[0]
    if stem in ("toa", "rtt", "range") or name == "snr_db":
        row = {"time_s": 0.0, "anchor": 1, "aoa_azimuth_rad": 0.1, "snr_db": 20.0}
    elif stem in ("speed", "aod_azimuth_body"):
        row |= {"heading_rad": 0.1, "speed_mps": 1.0}
    if stem == "speed":
        del row["speed_mps"]
    limit = SCHEMAS["log"]["properties"][name]["maximum"]
    for factor in (0.99, 1.01):
        line = row | {name: factor * limit}
        reads = True
        try:
            LiveLog(list(line), read_scene(LOGS / "canyon28_vehicle" / "scene.json")).add(line)
        except LogError:
            reads = False
        assert reads == VALIDATORS["log"].is_valid(line) == (factor < 1.0)


def test_rows_of_the_shipped_log_satisfy_the_schema():
    with (LOGS / "canyon28_vehicle" / "log.csv").open() as file:
        for row in csv.DictReader(file):
            numbers = {name: float(cell) if cell else None for name, cell in row.items()}
            VALIDATORS["log"].validate(numbers | {"anchor": int(row["anchor"])})
    assert not VALIDATORS["log"].is_valid({"time_s": 0.0, "anchor": 1, "snr_db": 10.0})
