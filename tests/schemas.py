"""JSON schemas of the files that users write, made from dataclasses that hold their content.

After changing such a dataclass, run ``make generated`` to write mmwave_env/data/schemas again.
"""

import inspect
import json
import math
import re
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from types import NoneType
from typing import Annotated, get_args, get_origin

from mmwave_env.filters import Mode
from mmwave_env.filters.bank import MOST_MODES, NOTES, Bank
from mmwave_env.filters.modes import ALGORITHMS
from mmwave_env.io.lookup import LONGEST
from mmwave_env.io.records import Bound, Printable, Size, hints_of
from mmwave_env.logs.log_columns import HORIZONTAL, QUANTITIES
from mmwave_env.metrics import METRICS, TERMS
from mmwave_env.models.radio import RADIOS, Radio
from mmwave_env.models.scene import AnchorScene, Scene
from mmwave_env.world.mobility import Mobility
from tests.paths import ROOT

FOLDER = ROOT / "mmwave_env" / "data" / "schemas"
TYPES = {str: "string", bool: "boolean", int: "integer", float: "number", NoneType: "null"}

# Readers refuse all unprintable characters, but a pattern can exclude only control characters.
NAME = {"minLength": 1, "maxLength": LONGEST, "pattern": r"^[^\x00-\x1f\x7f-\x9f]*$"}


def described(kind):
    """Return a dict from attributes to their descriptions in a dataclass's docstring."""
    _, _, section = inspect.getdoc(kind).partition("Attributes:\n")
    section = section.split("\n\n")[0]
    entries = re.findall(r"^    (\w[\w, ]*): (.*(?:\n {5,}.*)*)", section, re.MULTILINE)
    return {
        name: " ".join(text.replace("`", "").rstrip(".").split())
        for names, text in entries
        for name in names.split(", ")
    }


def bounds(bound):
    """Return the keywords of a schema for the bounds of a number."""
    low = {"exclusiveMinimum": bound.above} if bound.least is None else {"minimum": bound.least}
    high = {"exclusiveMaximum": bound.below} if bound.most is None else {"maximum": bound.most}
    return {key: value for key, value in (low | high).items() if math.isfinite(value)}


def schema_of(hint):
    """Return the schema of a field's type."""
    origin = get_origin(hint)
    inside = get_args(hint)
    if is_dataclass(hint):
        return object_schema(hint)
    if hint in TYPES:
        return {"type": TYPES[hint]}
    if origin is Annotated:
        base, limits = inside
        more = bounds(limits) if isinstance(limits, Bound) else {}
        more |= NAME if isinstance(limits, Printable) else {}
        more |= size(limits.least, limits.most) if isinstance(limits, Size) else {}
        return schema_of(base) | more
    if origin is tuple:
        count = {} if inside[-1] is ... else size(len(inside), len(inside))
        return {"type": "array", "items": schema_of(inside[0])} | count
    return {"anyOf": [*map(schema_of, inside)]}


def size(least, most):
    """Return the keywords of a schema for the length of a list."""
    return {"minItems": least, "maxItems": most}


def object_schema(kind, optional=(), replaced=None):
    """Return the schema of a dataclass.

    Files may omit the ``optional`` fields; ``replaced`` maps names of fields to other schemas.
    """
    texts = described(kind)
    properties = {}
    required = []
    for field in fields(kind):
        part = (replaced or {}).get(field.name) or schema_of(hints_of(kind)[field.name])
        if field.name in texts:
            part = part | {"description": texts[field.name]}
        with suppress(TypeError, ValueError):  # JSON cannot represent every default
            part = part | {"default": json.loads(json.dumps(field.default, allow_nan=False))}
        properties[field.name] = part
        if field.default is field.default_factory is MISSING and field.name not in optional:
            required.append(field.name)
    closed = {"required": required, "additionalProperties": False}
    return {"type": "object", "properties": properties} | closed


def radio():
    """Return the schema of a radio file: a base profile, and the fields that differ from it."""
    schema = object_schema(Radio, optional=["name"])
    properties = schema["properties"]
    for name in [n for n in properties if n.endswith("_rad")]:
        degrees = {k: v for k, v in properties[name].items() if k != "default"}
        for end, inward in {"minimum": math.ceil, "maximum": math.floor}.items():
            if end in degrees:
                degrees[end] = inward(1e9 * math.degrees(degrees[end])) / 1e9
        degrees["description"] += f", in degrees in place of {name}"
        properties[name.removesuffix("_rad") + "_deg"] = degrees
    properties["name"]["not"] = {"enum": list(RADIOS)}
    base = {"enum": list(RADIOS), "default": "standard"}
    about = "shipped profile for all that the file leaves out, including modes and banks"
    base["description"] = f"{about}; the defaults shown are those of 'standard'"
    return schema | {"properties": {"base": base} | properties | {"base": base}}


def modes():
    """Return the schema of a mode file: a bank of modes, and notes that readers ignore."""
    mode = object_schema(Mode, replaced={"algorithm": {"enum": list(ALGORITHMS)}})
    listed = {"type": "array", "items": mode} | size(1, MOST_MODES)
    bank = object_schema(Bank, replaced={"modes": listed})
    bank["properties"] |= {name: {"description": text} for name, text in NOTES.items()}
    return bank


def log():
    """Return the schema of a row of a log in JSON lines: each column, its unit and its limits."""
    properties = {}
    for quantity in QUANTITIES.values():
        for name, unit in quantity.columns.items():
            needed = quantity is QUANTITIES["time"]
            kind = "number" if needed else ["number", "null"]  # null: not measured
            part = {"type": kind, "description": quantity.meaning}
            by_carrier = name.startswith("doppler") and name.endswith("_mps")
            if quantity.limits and not by_carrier:
                bound, of = quantity.limits
                scale = (
                    (math.radians(1.0) if of == "degrees" else 1.0) * unit.divide / unit.multiply
                )
                part |= {
                    "minimum": float(f"{scale * bound.least:.12g}"),
                    "maximum": float(f"{scale * bound.most:.12g}"),
                }
            properties[name] = part
    properties["anchor"] = {"type": "integer", "minimum": 1, "description": "number in the scene"}

    def one_of(*quantities):
        names = [name for quantity in quantities for name in QUANTITIES[quantity].columns]
        return {"anyOf": [{"required": [name]} for name in names]}

    required = [one_of("time"), one_of("anchor"), one_of(*HORIZONTAL)]
    closed = {"allOf": required, "additionalProperties": False}
    return {"type": "object", "properties": properties} | closed


def results():
    """Return the shipped schema of results, with its metrics brought up to date."""
    schema = json.loads(path_of("results").read_text(encoding="utf-8"))
    texts = {name: metric.described for name, metric in METRICS.items()}
    texts |= {name: meaning for name, (_, meaning) in TERMS.items()}
    interval = {"$ref": "#/$defs/interval"}
    schema["$defs"]["metrics"] |= {
        "properties": {name: interval | {"description": text} for name, text in texts.items()},
        "required": list(METRICS),
    }
    return schema


def schemas():
    """Return all schemas by name."""
    scene = {"oneOf": [object_schema(kind, optional=["name"]) for kind in (Scene, AnchorScene)]}
    for form, title in zip(scene["oneOf"], ("by its walls", "by its anchors"), strict=True):
        form["title"] = title
    bodies = {
        "scene": ("A street: a base station and the walls that mirror it", scene),
        "radio": ("A radio profile", radio()),
        "modes": ("Filter modes", modes()),
        "log": ("A row of a measurement log: an epoch and an anchor", log()),
        "mobility": ("A kind of user", object_schema(Mobility, optional=["name"])),
    }
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    made = {name: dialect | {"title": title} | body for name, (title, body) in bodies.items()}
    return made | {"results": results()}


def path_of(name):
    """Return the path of a shipped schema."""
    return FOLDER / f"{name}.schema.json"


if __name__ == "__main__":
    for name, schema in schemas().items():
        path_of(name).write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")
