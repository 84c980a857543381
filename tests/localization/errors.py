"""Simulated logs, and errors that all links of a log share, as functions from readings."""

from dataclasses import replace

import numpy as np

from mmwave_env.filters.bank import default_modes
from mmwave_env.localization.readings import AZIMUTH, DEPARTURE, ELEVATION, RANGE, Reading
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.keys import keys_of
from tests.filters.tracks import street_source
from tests.logs.by_hand import log_with

STREET = SCENES["street"]


def mode_of(radio):
    """Return the mode with which logs are diagnosed."""
    return default_modes(radio)[-1]


def readings(count, radio="standard", scenario="pedestrian", seed=500_000, dt=1.0, epochs=200):
    """Return simulated logs in the street, each from the first link of its base station on."""
    source = street_source(scenario, radio, dt=dt, epochs=epochs)
    logs = []
    for e in source.episodes(keys_of(range(seed, seed + count))):
        log = log_with(e.layout, e.time_s, e.measurement, e.visible, e.snr_db)
        log = replace(log, doppler_spread_hz=e.doppler_spread_hz)
        logs.append(log.part(slice(int(np.argmax(log.visible[:, 0])), None)))
    return [Reading(log, STREET, RADIOS[radio], mode_of(radio)) for log in logs]


def shifted(*rows, by):
    """Return an error that adds a number to rows."""

    def error(reading):
        z = reading.log.measurement.copy()
        for some in rows:
            z[:, some] += by
        return reading._replace(log=replace(reading.log, measurement=z))

    return error


def turned(degrees):
    return shifted(AZIMUTH, DEPARTURE, by=np.radians(degrees))


def tilted(degrees):
    return shifted(ELEVATION, by=np.radians(degrees))


def late(meters):
    return shifted(RANGE, by=meters)


def drifting(meters):
    """Return the error of a clock that gains so many meters in 100 s."""

    def error(reading):
        time_s = reading.log.time_s
        gained = meters * (time_s - time_s[0]) / 100.0
        return shifted(RANGE, by=gained[:, None])(reading)

    return error


def moved(anchor, *meters):
    """Return an error that moves an anchor of the scene, from 0, away from its true place."""

    def error(reading):
        anchors = reading.scene.anchors_m
        anchors[anchor] -= meters
        return reading._replace(scene=reading.scene.with_anchors(anchors))

    return error


def only(reading, rows):
    """Return a reading whose log lacks the other rows."""
    log = reading.log
    z = np.where(np.isin(np.arange(log.layout.size), rows), log.measurement, np.nan)
    visible = log.visible.copy()
    visible[:, -1] &= log.layout.doppler in rows
    layout = replace(log.layout, partial=True)
    return reading._replace(log=replace(log, layout=layout, measurement=z, visible=visible))
