"""Tests that live rows give the same track as a log file, and take little work and memory.

For live rows, there are quick methods of parsing a row and of loading an epoch into the filter.
Where these methods can't be used, the methods for log files (the careful methods) are used.
"""

import cProfile
import os
import pstats
import tracemalloc
from contextlib import suppress
from itertools import groupby, product
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest

from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.tracker import Tracker
from mmwave_env.logs.live_log import LiveLog, log_from
from mmwave_env.logs.log import read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene
from mmwave_env.world.episode import Episode
from policies import load
from tests.paths import LOGS, records, representative

WALK = LOGS / "canyon28_pedestrian"
SCENE = read_scene(WALK / "scene.json")
RADIO = RADIOS["standard"]
EKF = named_modes()["ekf"]


def tracker_of(**options):
    return Tracker(SCENE, Switching((EKF,)), RADIO, **options)


def walk(count=60, **changed):
    """Return the first epochs of a shipped log (lists of dicts by column) with changed columns.

    A keyword names a column; its value is a function from row to cell, or None to drop the column.
    """
    lines = records(WALK / "log.csv")
    rows = [{k: float(v) if v else None for k, v in line.items()} for line in lines]
    rows = [row | {name: make and make(row) for name, make in changed.items()} for row in rows]
    for row, name in product(rows, [name for name, make in changed.items() if make is None]):
        del row[name]
    return [list(rows) for _, rows in groupby(rows, lambda row: row["time_s"])][:count]


def of(name, function):
    """Return a function that applies ``function`` to a row's cell ``name``; None stays None."""
    return lambda row: None if row[name] is None else function(row[name])


OWN = {"range_sigma_m": 0.4, "aoa_azimuth_sigma_deg": 1.0, "aoa_elevation_sigma_rad": 0.02}
OWN |= {"aod_azimuth_sigma_rad": 0.03, "doppler_sigma_hz": 40.0}
AZIMUTH = "aoa_azimuth_rad"
DEPARTURE = "aod_azimuth_rad"
UNITS = {AZIMUTH: None, "aoa_azimuth_deg": of(AZIMUTH, lambda a: np.degrees(a) % 360.0)}
UNITS |= {"toa_s": None, "rtt_ns": of("toa_s", lambda t: 2e9 * t)}
MOVES = {"speed_mps": lambda row: 1.2, "heading_deg": lambda row: 350.0}
BODY = MOVES | {DEPARTURE: None, "aod_azimuth_body_rad": of(DEPARTURE, lambda a: a - 6.0)}
SECOND = {"doppler_hz": lambda row: -20.0 if row["anchor"] == 2 else None}
# name -> changed columns, whether the quick method loads the epochs, arguments of both
LOGGED = {
    "as it is": ({}, True, {}),
    "other units": (UNITS, True, {}),
    "own noise": ({"snr_db": None} | {k: lambda row, v=v: v for k, v in OWN.items()}, True, {}),
    "an SNR as argument": ({"snr_db": None}, True, {"snr_db": 18.0}),
    "a Doppler shift of anchor 2": (SECOND, True, {"snr_db": 20.0}),
    "odometry": (MOVES, True, {}),
    "angles of the body": (BODY, False, {}),
    "a clock with an offset": ({}, True, {"clock": "offset"}),
    "a free clock": ({}, True, {"clock": "free"}),
}


@pytest.mark.parametrize("name", representative(LOGGED, *[*LOGGED][:-2]))
def test_live_epochs_equal_epochs_of_a_log_to_the_last_bit(tmp_path, name):
    changed, quick, options = LOGGED[name]
    epochs = walk(**changed)
    path = tmp_path / "log.csv"
    pd.DataFrame([row for epoch in epochs for row in epoch]).to_csv(path, index=False)
    log = read_log(path, SCENE, **options)
    track = localize(log, SCENE, RADIO, Switching((EKF,)), window=None)
    tracker = tracker_of(**options)
    with patch.object(Episode, "table", autospec=True, side_effect=Episode.table) as careful:
        positions = [tracker.update(epoch) for epoch in epochs]
    np.testing.assert_array_equal([p.position_m for p in positions if p], track.x[:, :3])
    if "clock" in options:
        assert [p.clock_m for p in positions if p] == track.x[:, 7].tolist()
    assert [len(p.nis) for p in positions if p] == track.visible.sum(axis=1).tolist()
    assert careful.call_count == (1 if quick else len(epochs))  # one to begin


VALUES = [0.0, -1e-9, 1e-7, 89.9999999, 90.0, 90.00009, 90.001, 360.0, 360.00001, 361.0, 1e5, 1e9]
VALUES += [-90.0, 1.0, 2.0, 1.5, 3.3e-3, 3.34e-3, np.inf, np.nan, None, True, 10**400]
VALUES += [np.float32(0.1), np.float64(0.1), "1_0", "x"]
ROW = {"time_s": 1.0, "anchor": 1.0, "toa_s": 2e-7, "aoa_azimuth_deg": 40.0}
ROW |= {"aoa_elevation_rad": -0.1, "aod_azimuth_deg": -140.0, "doppler_mps": 1.5, "snr_db": 20.0}
ROW |= {"doppler_spread_khz": 0.1, "speed_kmh": 5.0, "heading_deg": 30.0, "toa_sigma_ns": 2.0}


def outcome(rows):
    """Return the values of the last epoch in these rows, or the message of the first error."""
    log = LiveLog(list(ROW), SCENE)
    try:
        epochs = [epoch for row in rows for epoch in log.add(row, 7)]
        last = log_from([*epochs, *log.end_epoch()][-1:])
    except LogError as error:
        return str(error)
    return repr([last.measurement, last.sigma, last.snr_db, last.doppler_spread_hz])


@pytest.mark.parametrize("name", ROW)
@pytest.mark.parametrize("first", [[], [ROW | {"anchor": 2.0}]], ids=["alone", "second"])
def test_quick_and_careful_reading_accept_and_refuse_the_same_rows(name, first):
    for value in VALUES:
        row = ROW | {name: value}
        # Cells that begin with a space are read by the careful method, which must accept them.
        text = {n: "" if v is None else f" {v!s}" for n, v in row.items()}
        line = ",".join(word.strip() for word in text.values())
        outcomes = {outcome([*first, row]), outcome([*first, text]), outcome([*first, line])}
        assert len(outcomes) == 1, (value, outcomes)


@pytest.mark.slow
def test_an_epoch_takes_little_work_and_no_lasting_memory():
    tracker = Tracker(SCENE, load("guided"), RADIO)
    epochs = walk(300)
    for epoch in epochs[:100]:
        tracker.update(epoch)
    files = len(os.listdir("/dev/fd"))
    profile = cProfile.Profile()
    tracemalloc.start()
    for epoch in epochs[100:200]:
        tracker.update(epoch)
    before = tracemalloc.get_traced_memory()[0]
    profile.runcall(lambda: [tracker.update(epoch) for epoch in epochs[200:250]])
    assert tracemalloc.get_traced_memory()[0] < before + 100_000
    tracemalloc.stop()
    # At most 600 calls of functions per epoch, on average: 10,000 calls take about 1 ms.
    assert pstats.Stats(profile).total_calls < 600 * 50
    assert len(os.listdir("/dev/fd")) == files


STREAMS = {  # name -> change of the time of an epoch, given its number; epochs that may be lost
    "one time in the future": (lambda n, t: t + 1e9 if n == 20 else t, 3),
    "a minute ahead for one epoch": (lambda n, t: t + 60.0 if n == 20 else t, 3),
    "a clock set back": (lambda n, t: t + 3600.0 if n < 30 else t, 2),
    "a clock set back twice": (lambda n, t: t - 3600.0 * (n >= 30) - 1800.0 * (n >= 32), 4),
    "a week that wraps": (lambda n, t: (604_770.0 + t) % 604_800.0, 2),
    "a receiver that restarts": (lambda n, t: t - 30.0 * (n >= 30), 2),
}


@pytest.mark.parametrize("stream", STREAMS)
def test_live_goes_on_after_wrong_times(stream):
    change, lost = STREAMS[stream]
    epochs = walk()
    tracker = tracker_of()
    positions = []
    for number, rows in enumerate(epochs):
        with suppress(LogError):
            changed = [row | {"time_s": change(number, row["time_s"])} for row in rows]
            positions.append(tracker.update(changed))
    assert len([p for p in positions if p]) >= len(epochs) - lost
    assert positions[-1].time_s == change(len(epochs) - 1, epochs[-1][0]["time_s"])
    assert sum(p.begins for p in positions if p) <= 3


def test_a_clock_that_is_set_back_while_nothing_is_heard_begins_a_new_track():
    tracker = tracker_of()
    begun = []
    for number, rows in enumerate(walk()):
        times = [{"time_s": row["time_s"] - 0.65 * (number >= 38)} for row in rows]
        silent = 30 <= number < 38
        heard = [{"anchor": row["anchor"]} if silent else row for row in rows]
        with suppress(LogError):
            position = tracker.update([h | t for h, t in zip(heard, times, strict=True)])
            begun += [number] if position.begins else []
    assert len(begun) == 2 and 38 <= begun[1] <= 43


@pytest.mark.parametrize("first", [0, 3])
def test_rows_may_have_other_keys_than_the_first_row(first):
    """Check that keys may appear later, and that unknown keys are named once and ignored."""
    whole = tracker_of()
    expected = [whole.update(rows) for rows in walk(20)]
    tracker = tracker_of()
    positions = []
    for number, rows in enumerate(walk(20)):
        measured = [{k: v for k, v in row.items() if v is not None} for row in rows[::-1]]
        if number == first:
            with pytest.warns(UserWarning, match="rssi"):
                positions.append(tracker.update([row | {"rssi": -70.0} for row in measured]))
        else:
            more = {"rssi": -70.0} if number > first else {}
            positions.append(tracker.update([row | more for row in measured]))
    assert positions == expected


def test_the_first_epoch_may_lack_columns_that_a_log_needs():
    epochs = walk(20)
    whole = tracker_of()
    expected = [whole.update(rows) for rows in epochs[1:]]
    tracker = tracker_of()
    lost = [{name: row[name] for name in ("time_s", "anchor", "snr_db")} for row in epochs[0]]
    assert tracker.update(lost) is None
    assert [tracker.update(rows) for rows in epochs[1:]] == expected
    with pytest.raises(ValueError, match="say nothing about the horizontal position"):
        tracker_of().update(60 * lost)


def test_rows_behind_a_damaged_one_and_repeated_rows_with_new_keys():
    row = walk()[0][0]
    log = LiveLog([], SCENE)
    log.add({"time_s": "abc"})
    with pytest.raises(LogError):
        log.add(row)
    assert log.end_epoch()
    log.add({**row, "time_s": 9.0, "doppler_spread_hz": 3.0})
    log.add(row)
    assert log.left_out == {"repeated rows": 1}


LATER = {
    "odometry": lambda row: row | {"speed_mps": 1.2, "heading_deg": 350.0},
    "a long gap": lambda row: row | {"time_s": row["time_s"] + 100.0},
}


@pytest.mark.parametrize("name", LATER)
def test_odometry_that_appears_later_or_a_long_gap_begins_a_new_track(name):
    epochs = walk(20)
    epochs[10:] = [list(map(LATER[name], rows)) for rows in epochs[10:]]
    tracker = tracker_of()
    positions = [tracker.update(rows) for rows in epochs]
    assert [n for n, p in enumerate(positions) if p is None or p.begins] == [0, 10]
    assert ("odometry" in positions[-1].nis) == (name == "odometry")


@pytest.mark.parametrize(
    "policy",
    [Switching((EKF,)), load("corrector", "standard")],
    ids=["ekf", "corrector"],
)
def test_users_who_come_and_go_have_the_positions_of_trackers_of_their_own(policy):
    epochs = walk(40)
    begins = {f"user_{i}": i for i in range(36)}  # epoch in which a user comes
    trackers = Tracker(SCENE, policy, RADIO, levels=Levels())
    alone = {name: Tracker(SCENE, policy, RADIO, levels=Levels()) for name in begins}
    count = 0
    for t in range(75):
        rows = []
        expected = {}
        for name, begin in begins.items():
            if begin <= t < begin + len(epochs) and (t + begin) % 7:  # with gaps
                moved = [
                    row | {"time_s": row["time_s"] - epochs[0][0]["time_s"] + 0.1 * begin}
                    for row in epochs[t - begin]
                ]
                rows += [row | {"ue": name} for row in moved]
                position = alone[name].update(moved)
                if position:
                    expected[name] = position
        positions = trackers.update_users(rows)
        assert positions == expected
        count += len(positions)
    assert count > 1_100  # of 36 users with 34 or 35 epochs each


def test_users_who_left_are_forgotten_and_memory_stays_flat():
    tracker = tracker_of()
    first, *_ = walk(1)
    for t in range(200):  # a new user every second, of whom each sends a single epoch
        rows = [row | {"ue": f"user {t}", "time_s": float(t)} for row in first]
        (position,) = tracker.update_users(rows).values()
        assert position.begins and len(tracker._users) <= 20
    ahead = [row | {"ue": "user 199", "time_s": 1e9} for row in first]  # a wrong clock
    tracker.update_users(ahead)
    assert len(tracker._users) > 10
