"""Options of mmwave-loc inspect."""

from dataclasses import dataclass, field
from pathlib import Path

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """What a data set is: its format, epochs, rate, anchors, speeds, and the problems found.

    Of a damaged file it tells what comes before the damage, and ends as localize does.

    mmwave-loc inspect canyon28_vehicle --plot vehicle.png
    """

    data: str = field(metadata={"positional": True})
    """measurement log or its folder, folder of a DeepMIMO scenario, track in TUM format, way (CSV),
    or canyon28_vehicle, canyon28_pedestrian"""
    scene: str | None = None
    """of a log: street, o1, dynamic-doppler or a JSON file (where none is given, scene.json beside
    it)"""
    truth: Path | None = None
    """of a log: true track in TUM format (where none is given, truth.tum beside it)"""
    radio: str = "handset"
    """of a log: handset, standard, high or a JSON file, to judge its numbers by"""
    plot: Path | None = None
    """draw where the user was and which anchor was seen when, to this .png, .svg or .pdf file"""
