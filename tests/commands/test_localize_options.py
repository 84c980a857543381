"""Tests of the options --live, --associate and --diagnose of ``mmwave-loc localize``."""

import json
import re
import signal
import subprocess

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, norm

from experiments.console.main import run
from mmwave_env.datasets.recorded import TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.filters.bank import default_modes
from mmwave_env.localization.map_learning import MapLearner, learned_scene
from mmwave_env.logs.log import read_paths
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene
from tests.cli import assert_refused, command, started, succeed, with_json
from tests.commands.localizing import RIDE, STREET, WALK, figures, lines_of, options, refused
from tests.console.test_signals import heed
from tests.filters.tracks import sampled
from tests.localization.mistakes import (
    AZIMUTHS,
    MISTAKES,
    differences,
    linear,
    read_columns,
    write_columns,
    wrong_log,
)
from tests.logs.by_hand import hide_anchors
from tests.paths import json_in

# --- rows that arrive one by one (--live)

WORDS = ("localize", "-", "--live", "--scene", WALK / "scene.json", "--radio", "standard")


def live(content, *more, code=0):
    """Run the command with bytes as input, and check its exit code.

    Return its JSON lines and its error lines.
    """
    done = command(*WORDS, *more, stdin=content)
    assert done.returncode == code
    positions = [json.loads(line) for line in done.stdout.splitlines()]
    return positions, done.stderr.splitlines()


def positions_of(content, *more):
    """Return the positions of a user whose speed is given."""
    return live(content, "--speed", "1", *more)[0]


def first_rows(count):
    """Return the header and the first rows of the walk, as bytes of CSV."""
    return "\n".join(lines_of()[: count + 1]).encode() + b"\n"


def as_json(lines, whole):
    """Return CSV lines as JSON lines; each contains a row, or an epoch if ``whole`` is True."""
    names, *rows = (line.split(",") for line in lines)
    objects = [
        {n: float(v) if v else None for n, v in zip(names, row, strict=True)} for row in rows
    ]
    if whole:
        times = dict.fromkeys(row["time_s"] for row in objects)
        objects = [{"rows": [r for r in objects if r["time_s"] == t]} for t in times]
    return "\n".join(map(json.dumps, objects)).encode()


def assert_ends_like_a_track_file(positions, track, *more, **options):
    """Localize the walk or a log, and check that the filtered track has the same end."""
    figures(WALK, "--radio", "standard", "--no-smoothing", "--out", track, *more, **options)
    last = read_tum(track).position_m[-1]
    assert positions[-1]["position_m"] == pytest.approx(last, abs=1e-9)


def test_live_output_has_a_line_per_epoch_and_ends_like_a_track_file(tmp_path):
    content = (WALK / "log.csv").read_bytes()
    positions, errors = live(content, "--speed", "1")
    # The only line of standard error explains the choice of modes.
    assert len(positions) == 400 and len(errors) == 1
    assert_ends_like_a_track_file(positions, tmp_path / "t.tum", "--speed", "1")
    assert positions[0]["begins"] and not any(p["begins"] for p in positions[1:])


@pytest.mark.parametrize("whole", [False, True], ids=["rows", "epochs"])
def test_json_lines_give_the_same_positions_as_csv(whole):
    json_lines = as_json(lines_of()[:61], whole)
    assert positions_of(json_lines) == positions_of(first_rows(60))


@pytest.mark.parametrize("kept", [["snr_db"], ["doppler_hz"], ["toa_s"]])
def test_the_first_json_rows_may_lack_columns(kept):
    """The first row may also have odometry in part, which is used once it is complete."""
    first, *others = (json.loads(line) for line in as_json(lines_of()[:61], False).splitlines())
    sparse = {name: first[name] for name in ("time_s", "anchor", *kept)} | {"speed_mps": 1.0}
    moving = [row | {"speed_mps": 1.0, "heading_rad": 0.0} for row in others]
    lines = [json.dumps(sparse), "{damaged", *map(json.dumps, moving)]
    positions, errors = live("\n".join(lines).encode(), "--speed", "1")
    assert "line 2: found '{damaged'" in errors[0]
    assert len(positions) == len({row["time_s"] for row in others})
    assert "odometry" in positions[-1]["nis"]


def test_the_default_policy_depends_on_the_columns_and_not_on_the_first_epoch(tmp_path):
    columns = read_columns(WALK / "log.csv")
    columns = {name: values[:60] for name, values in columns.items()}
    columns["aoa_elevation_rad"][:3] = np.nan
    log = tmp_path / "log.csv"
    write_columns(log, columns)
    positions, _ = live(log.read_bytes())
    assert_ends_like_a_track_file(positions, tmp_path / "t.tum", log=log, truth=False)


def test_keys_may_appear_while_the_first_positions_are_judged():
    lines = as_json(lines_of()[:391], False).splitlines()
    rows = [json.loads(line) for line in lines]
    rows[150:] = [row | {"speed_mps": 1.0, "heading_rad": 0.0} for row in rows[150:]]
    positions = positions_of("\n".join(map(json.dumps, rows)).encode())
    assert len(positions) == len({row["time_s"] for row in rows})


@pytest.mark.parametrize(
    ("folder", "name", "doubt"),
    [
        (RIDE, "azimuths have the other sign", "anchor 2: found NIS / dof"),
        (RIDE, "Doppler shift has the other sign", "Doppler: found a range that grows by -"),
        (WALK, "elevation has the other sign", "anchor 1: found a user above this anchor"),
    ],
)
def test_what_contradicts_the_first_positions_causes_a_warning(tmp_path, folder, name, doubt):
    log = wrong_log(tmp_path, folder, MISTAKES[name])
    _, (_, *warnings) = live(log.read_bytes(), "--scene", folder / "scene.json", "--speed", 1)
    assert any(doubt in warning for warning in warnings)


def test_rows_of_several_users_give_the_lines_of_each_alone():
    alone = positions_of(first_rows(60))
    header, *rows = lines_of()[:61]
    both = [f"{row},{user}" for row in rows for user in "ab"]
    lines, errors = live("\n".join([f"{header},ue", *both]).encode(), "--speed", "1")
    assert len(errors) == 1
    for user in "ab":
        assert [line for line in lines if line["ue"] == user] == [{"ue": user} | p for p in alone]


def test_location_data_of_3gpp_has_the_ellipse_in_which_the_user_is(tmp_path):
    origin = {"latitude_deg": 48.1, "longitude_deg": 11.5, "height_m": 500.0, "bearing_deg": 30.0}
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps(json_in(WALK / "scene.json") | {"origin": origin}))
    words = ("--scene", scene)
    asked = ("--format", "3gpp", "--confidence", "0.9", "--accuracy", "0.5")
    plain = positions_of(first_rows(60), *words)
    found = positions_of(first_rows(60), *words, *asked)
    assert len(found) == len(plain)
    position, content = plain[-1], found[-1]
    area = content["locationEstimate"]
    ellipse = area["uncertaintyEllipse"]
    P = np.array(position["covariance_m2"])
    variances, axes = np.linalg.eigh(P[:2, :2])
    size_m = np.sqrt(chi2.ppf(0.9, 2) * variances)
    assert [ellipse["semiMinor"], ellipse["semiMajor"]] == pytest.approx(size_m, rel=0.01)
    turned = np.radians(origin["bearing_deg"] - ellipse["orientationMajor"])
    along = axes[:, 1] @ [np.cos(turned), np.sin(turned)]  # x is in the direction of the bearing
    assert abs(along) == pytest.approx(1.0, abs=1e-4) and area["confidence"] == 90
    height_m = norm.ppf(0.95) * np.sqrt(P[2, 2])
    assert area["uncertaintyAltitude"] == pytest.approx(height_m, rel=0.01)
    place = area["point"]["lat"], area["point"]["lon"], area["altitude"]
    assert place == pytest.approx(position["geodetic"], abs=1e-12)
    velocity = content["velocityEstimate"]
    vx, vy, vz = position["velocity_mps"]
    bearing = origin["bearing_deg"] - np.degrees(np.arctan2(vy, vx))
    assert (velocity["bearing"] - bearing + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.51)
    assert velocity["hSpeed"] == pytest.approx(3.6 * np.hypot(vx, vy))
    assert velocity["vDirection"] == ("UPWARD" if vz >= 0.0 else "DOWNWARD")
    for line in found:
        met = line["locationEstimate"]["uncertaintyEllipse"]["semiMajor"] <= 0.5
        assert line["accuracyFulfilmentIndicator"].endswith("NOT_FULFILLED") != met


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("localize", "--sample", "canyon28_vehicle", "--format", "3gpp"), "format: .*--live"),
        ((*WORDS, "--accuracy", "5"), "accuracy: .*--format 3gpp"),
        ((*WORDS, "--format", "3gpp"), "format: 3gpp needs the origin"),
    ],
)
def test_options_of_live_positions_are_refused_where_they_would_be_ignored(words, message):
    header, row, *_ = lines_of()
    assert_refused(message, *words, stdin=f"{header},ue\n{row},a\n{row},b\n".encode())


def test_damaged_and_late_rows_are_reported_and_left_out():
    content = first_rows(30) + b"\x00\xff noise\n" + b"0.0,1,1e-7,0,0,0,0,20,0\n" + b"x" * 70_000
    tail = "\n".join(lines_of()[31:61]).encode()
    positions, errors = live(content + b"\n" + tail, "--speed", "1")
    assert positions == positions_of(first_rows(60))
    warned = [line for line in errors if line.startswith("warning")]
    assert [line.split(":")[1].strip() for line in warned] == [
        "standard input, line 32", "standard input, line 33, column 'time_s'",
        "standard input, line 34",
    ]  # fmt: skip


def test_a_damaged_row_of_an_epoch_loses_no_other_row_and_csv_may_have_semicolons_and_a_mark():
    damaged = as_json(lines_of()[:31], True).replace(b"}, {", b'}, {"time_s": "x"}, {')
    positions, errors = live(damaged, "--speed", "1")
    marked = b"\xef\xbb\xbf\n" + first_rows(30).replace(b",", b";")
    assert len(errors) > 9 and positions == positions_of(marked)


def test_a_live_log_that_determines_no_position_says_so_after_some_seconds():
    rows = [f"{t},1,{50 + t},20" for t in range(30)]
    content = "\n".join(["time_s,anchor,range_m,snr_db", *rows, ""]).encode()
    positions, errors = live(content, "--speed", "1")
    assert not positions and len(errors) == 2
    assert (
        "found no position in 10 s, only the columns anchor, range_m, snr_db, time_s of anchor 1;"
        in errors[0]
    )


@pytest.mark.parametrize("content", [b"", b"\n", b"time,mood\n1,2\n", b'{"rows": 5}\n', b"[1]\n"])
def test_input_that_is_not_a_log_is_refused_in_one_line(content):
    positions, errors = live(content, code=2)
    assert not positions and len(errors) == 1


@pytest.mark.parametrize(
    "more",
    [
        ("--truth", "t.tum"),
        ("--out", "t.tum"),
        ("--associate",),
        ("--no-odometry",),
        ("--correlation", "-1"),
        ("--write", "s.json"),
        ("--window", "50"),
        ("--no-smoothing",),
    ],
)
def test_options_that_conflict_with_live_are_refused(more):
    _, errors = live(first_rows(3), *more, code=2)
    assert more[0].removeprefix("--").removeprefix("no-") in errors[0].split(":")[1]


def ride(log, *more):
    """Return the words after ``localize`` for a log of the ride."""
    return options(log, "--radio", "standard", *more, folder=RIDE)


# --- paths without anchor numbers


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """Return a log of propagation paths without anchor numbers; false paths belong to no anchor."""
    log = tmp_path_factory.mktemp("hidden") / "log.csv"
    source = TrackSource(read_track(RIDE), "standard")
    hide_anchors(log, sampled(source), false_paths=5)
    return log


def test_the_command_reports_how_many_paths_were_associated_with_each_anchor(hidden):
    shown, figures = with_json("localize", *ride(hidden, "--speed", "auto", "--associate"))
    association = figures["association"]
    count = len(hidden.read_text().splitlines()) - 1
    assert (
        f"- {count} paths, {association['false']} of them false; the track was found once\n"
        in shown
    )
    for name, paths in association["associated"].items():
        assert f"| {name} | {paths} | {association['missed'][name]} |\n" in shown


def test_a_log_of_paths_needs_the_option_that_finds_their_anchors(hidden):
    _, line = refused(ride(hidden))
    assert "found no anchor" in line and "--associate" in line


@pytest.mark.parametrize(
    ("mistake", "advice"),
    [
        (linear(1.0), None),
        pytest.param(linear(1.0, "toa_s", offset=50e-9), "", marks=pytest.mark.slow),
        (linear(1.0, *AZIMUTHS, offset=np.radians(8.0)), 'to correct it, write "bearing_deg": '),
    ],
    ids=["right", "clock ahead", "azimuths turned"],
)
def test_paths_that_do_not_fit_the_map_cause_a_warning(tmp_path, mistake, advice):
    log = wrong_log(tmp_path, STREET, mistake)
    words = options(log, "--radio", "standard", "--associate", "--imm", "imm-best", folder=STREET)
    done = command("localize", *words)
    assert done.returncode == 0
    if advice is None:
        assert done.stderr == ""
    else:
        assert "do not trust the track" in done.stderr and advice in done.stderr


# --- a place without a map

PATHS = (STREET / "log.csv").read_bytes()


def learning(folder):
    """Return the options that learn the map of a folder."""
    return "--scene", folder / "base-station.json", "--radio", "standard", "--map", "learn"


@pytest.mark.slow
def test_a_map_is_learned_from_the_sample_written_and_used(tmp_path):
    file = tmp_path / "learned.json"
    options = ("--sample", STREET.name, "--radio", "standard", "--map", "learn")
    words = (*options, "--imm", "imm-best", "--map-out", str(file))
    shown, figures = with_json("localize", *words)
    scene = read_scene(file)
    images = figures["map"]["images"]
    assert [image["position_m"] for image in images] == scene.anchors_m[1:].tolist()
    assert len(images) == 2 and images[0]["paths"] == scene.learned[0].paths
    assert list(figures["association"]["associated"]) == ["anchor 1", "anchor 2", "anchor 3"]
    assert figures["truth"]["tracks"]["smoothed"]["ate_m"] < 1.0
    share = 100.0 * figures["map"]["explained"] / figures["map"]["paths"]
    assert f"explained {share:.1f} % of" in shown and "| anchor 2 | " in shown


@pytest.mark.slow
def test_a_map_is_learned_live_from_csv_and_json_as_from_the_file(tmp_path):
    words = learning(STREET)
    lines = (STREET / "log.csv").read_text().splitlines()
    of_csv, errors = live("\n".join(lines).encode(), *words, "--map-out", tmp_path / "a.json")
    assert not errors and of_csv[-1]["images"] == 2
    assert [line["time_s"] for line in of_csv] == [*range(200)]
    assert live(as_json(lines, True), *words)[0] == of_csv
    scene = read_scene(STREET / "base-station.json")
    learner = MapLearner(scene, RADIOS["standard"], default_modes("standard")[-1])
    log = read_paths(STREET / "log.csv", scene)
    beliefs = [*learner.follow(learner.observed(log))]
    assert [line["position_m"] for line in of_csv] == [b.x[:3].tolist() for b in beliefs]
    assert read_scene(tmp_path / "a.json") == learned_scene(scene, beliefs[-1])


def test_a_live_map_without_a_track_is_not_written_and_a_wrong_name_is_refused_first(tmp_path):
    words = learning(STREET)
    # on a line of sight, arrival and departure are opposite
    head = b"time_s,range_m,aoa_azimuth_deg,aod_azimuth_deg,snr_db\n0,100,10,10,20\n"
    positions, (warning,) = live(head, *words, "--map-out", tmp_path / "map.json")
    assert not positions and "no path with which a track can begin" in warning
    _, (line,) = live(head, *words, "--map-out", tmp_path / "map.csv", code=2)
    assert "map-out" in line and not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_live_map_is_written_if_the_program_is_ended(tmp_path, number):
    words = learning(STREET)
    file = tmp_path / "map.json"
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": False}
    child = started("localize", "-", "--live", *words, "--map-out", file, **pipes, preexec_fn=heed)
    with child:
        child.stdin.write(PATHS)
        child.stdin.flush()
        for _ in range(150):
            child.stdout.readline()
        child.send_signal(number)
        child.stdout.read()
    assert child.returncode in (130, 143) and len(read_scene(file).learned) == 2


@pytest.mark.slow
def test_a_live_map_that_explains_few_paths_causes_one_warning(tmp_path):
    words = ["--paths", "--false-paths", "12", "--episode-steps", "50", "--seed", "5"]
    run("simulate", [*words, "--radio", "standard", "--out", str(tmp_path)])
    scene = learning(tmp_path)
    positions, (warning,) = live((tmp_path / "log.csv").read_bytes(), *scene)
    assert len(positions) > 30
    assert re.search(r"map: found \d+ of \d+ paths .* expected 25% or more", warning)


@pytest.mark.parametrize(
    "more",
    [
        ("--policy", "guided"),
        ("--clock", "free"),
        ("--risk", "0.01"),
        ("--robust",),
        ("--follow", "odometry"),
    ],
)
def test_options_without_effect_on_a_map_that_is_learned_live_are_refused(more):
    words = learning(STREET)
    _, (line,) = live(PATHS, *words, *more, code=2)
    assert f"{more[0].removeprefix('--')}: cannot be combined with --map" in line


def test_a_live_map_does_not_replace_the_scene(tmp_path):
    scene = tmp_path / "base-station.json"
    scene.write_bytes((STREET / scene.name).read_bytes())
    _, (line,) = live(PATHS, *learning(tmp_path), "--map-out", scene, code=2)
    assert f"map-out: found {scene}" in line
    assert scene.read_bytes() == (STREET / scene.name).read_bytes()


@pytest.mark.parametrize(
    ("field", "more"),
    [
        ("map_out", ("--map", "known", "--map-out", "learned.json")),
        ("map-out", ("--map-out", "learned.csv")),
        ("diagnose", ("--diagnose",)),
        ("clock", ("--clock", "offset")),
    ],
)
def test_options_that_do_not_fit_a_map_are_refused(tmp_path, field, more):
    _, line = refused([STREET / "log.csv", *learning(STREET), *more], cwd=tmp_path)
    assert field in line and not list(tmp_path.iterdir())


def test_a_log_in_which_no_track_begins_is_refused_and_nothing_is_written(tmp_path):
    # on a line of sight, arrival and departure are opposite
    wrong_log(tmp_path, STREET, lambda c: c | {"aod_azimuth_rad": c["aoa_azimuth_rad"]})
    (tmp_path / "base-station.json").write_text((STREET / "base-station.json").read_text())
    words = (*learning(tmp_path), "--map-out", tmp_path / "learned.json")
    _, line = refused([tmp_path / "log.csv", *words], cwd=tmp_path)
    assert "log 1 of 1: " in line and not (tmp_path / "learned.json").exists()


# --- logs that contradict their scene

DOWNLINK = "arrival is measured at the user (downlink)"


@pytest.fixture(scope="module")
def downlink(tmp_path_factory):
    """Return a copy of the ride's log with angles of arrival at the user, as in a downlink."""
    return wrong_log(tmp_path_factory.mktemp("downlink"), RIDE, MISTAKES[DOWNLINK])


def test_each_contradiction_is_shown_as_a_warning_and_written_to_json(tmp_path, downlink):
    words = ride(downlink, "--speed", "auto", "--json", tmp_path / "found.json")
    done = command("localize", *words)
    assert done.returncode == 0 and "NIS / dof" in done.stdout
    lines = done.stderr.splitlines()
    warning = "warning: anchor 1: found .*, expected .*; --diagnose looks for a likely mistake"
    assert re.fullmatch(warning, lines[0])
    said = json_in(tmp_path / "found.json")["contradictions"]
    assert len(said) == len(lines)
    for line, contradiction in zip(lines, said, strict=True):
        assert "{group}: found {found}, expected {expected};".format(**contradiction) in line


def test_a_diagnosis_names_the_mistake_and_writes_no_track(tmp_path, downlink):
    before = downlink.read_bytes()
    file = tmp_path / "found.json"
    done = command("localize", *ride(downlink, "--diagnose", "--json", file))
    assert done.returncode == 0 and done.stderr == "" and downlink.read_bytes() == before
    assert f"\nThe log is consistent if {DOWNLINK}." in done.stdout
    cure = "exchange the names aoa_azimuth and aod_azimuth, negate aoa_elevation"
    assert f"To correct it, {cure} (docs/data.md)." in done.stdout
    first, *others = json_in(file)["hypotheses"]
    assert first["hypothesis"] == DOWNLINK and first["contradictions"] == []
    assert all(other["contradictions"] for other in others)


def test_a_log_that_is_refused_can_be_diagnosed(tmp_path):
    words = ride(wrong_log(tmp_path, RIDE, MISTAKES["angles are in degrees"]))
    refusal = command("localize", *words, "--speed", "auto")
    assert refusal.returncode == 2
    assert "if the value is in degrees, name the column aoa_azimuth_deg; mmwave" in refusal.stderr
    done = command("localize", *words, "--diagnose")
    assert "\nThe log is consistent if angles are in degrees." in done.stdout
    assert "not looked for" not in done.stdout  # as if the track were too short


def test_two_mistakes_are_diagnosed_although_wrong_values_suggest_another_radio(tmp_path):
    names = ("times are round-trip times", "angles are in degrees")
    first, second = names
    log = wrong_log(tmp_path, RIDE, lambda columns: MISTAKES[second](MISTAKES[first](columns)))
    words = options(log, "--diagnose", folder=RIDE)
    assert f"consistent if {'; '.join(names)}." in succeed("localize", *words)


def test_a_log_whose_track_does_not_fit_is_not_called_consistent(tmp_path):
    def late(columns):
        return columns | {"toa_s": columns["toa_s"] + 1e-6 * (columns["time_s"] > 20.0)}

    log = wrong_log(tmp_path, WALK, late)
    scene = tmp_path / "corrected.json"
    words = options(log, "--radio", "standard", "--diagnose", "--write", scene)
    shown = succeed("localize", *words)
    assert "\nNo hypothesis makes the log consistent." in shown
    assert "anchor 1: found NIS" in shown
    assert "Not written: no correction is known." in shown and not scene.exists()


@pytest.mark.parametrize(
    ("epochs", "place"),
    [(5, "40,12,1.5"), (60, "40,12,1.5"), (60, "10.3,10,6.5")],
    ids=["few epochs", "many epochs", "below an anchor"],
)
def test_a_user_who_stands_still_is_no_mistake_of_the_log(tmp_path, epochs, place):
    way = tmp_path / "still.csv"
    way.write_text("t,x,y,z\n" + "".join(f"{t},{place}\n" for t in range(epochs)))
    command("simulate", "--scenario", way, "--out", tmp_path)
    words = options(tmp_path / "log.csv", "--diagnose", folder=tmp_path)
    assert "\nThe log is consistent as it is." in succeed("localize", *words)


def test_a_wrong_doppler_shift_is_found_in_a_log_without_departures(tmp_path):
    log = wrong_log(tmp_path, RIDE, MISTAKES["Doppler shift has the other sign"])
    columns = read_columns(log)
    del columns["aod_azimuth_rad"]
    write_columns(log, columns)
    said = command("localize", *ride(log, "--speed", 1)).stderr
    assert "Doppler: found a range that grows by -" in said


def room(z):
    """Return anchors of one height in the corners of a room."""
    return [[0, 0, z], [60, 0, z], [60, 40, z], [0, 40, z]]


TRIANGLE = [[0, 0, 8], [60, 0, 10], [30, 50, 9]]  # anchors


@pytest.mark.parametrize(
    ("anchors", "clock", "warned"),
    [
        (room(3), "synchronized", True),
        (room(10), "synchronized", False),
        (room(-9), "synchronized", True),
        ([[0, 0, 6], [60, 0, 8]], "synchronized", True),
        (TRIANGLE, "synchronized", False),
        (TRIANGLE, "offset", True),
    ],
)
def test_anchors_that_may_mirror_a_track_cause_a_warning(tmp_path, anchors, clock, warned):
    words = (*walked(tmp_path, anchors, 20), "--clock", clock)
    assert ("warning: heights:" in command(*words).stderr) == warned
    assert command(*words, "--height", 1.5).stderr == ""


def walked(folder, anchors, y, hill_m=0.0):
    """Simulate ranges of a user who walks along x, over hills; return a command that localizes."""
    base, *others = anchors
    scene = {"base_station_m": base, "virtual_anchors_m": others, "carrier_hz": 28e9, "walls": []}
    scene["side"] = [30, 20]
    place = folder / "place.json"
    place.write_text(json.dumps({"name": "place"} | scene))
    way = folder / "way.csv"
    way.write_text(
        "t,x,y,z\n"
        + "".join(f"{t},{5 + t / 4},{y},{1.5 + hill_m * np.sin(t / 9) ** 2}\n" for t in range(60))
    )
    options_of = ("--scene", place, "--scenario", way, "--measurements", "range")
    command("simulate", *options_of, "--out", folder)
    return "localize", *options(folder / "log.csv", folder=folder)


def test_a_user_on_hills_is_followed_if_the_option_climb_says_so(tmp_path):
    words = walked(tmp_path, [*room(12), [30, 20, 4]], 10, 6.0)
    nees = []
    for more in ((), ("--climb", 0.3)):
        _, results = with_json(
            *words, "--truth", tmp_path / "truth.tum", "--imm", "imm-best", *more
        )
        nees.append(results["truth"]["tracks"]["smoothed"]["nees"])
    assert nees[1] < 4.0 < nees[0]


@pytest.mark.parametrize("odometry", [{}, {"speed_mps": 0.25, "heading_rad": 0.0}])
def test_a_track_near_the_line_of_its_anchors_may_change_sides(tmp_path, odometry):
    words = walked(tmp_path, [[0, 0, 6], [60, 0, 8]], 1)
    wrong_log(tmp_path, tmp_path, lambda columns: dict(pd.DataFrame(columns).assign(**odometry)))
    assert "warning: side: " in command(*words, "--height", 1.5).stderr
    assert "warning: heights: " in command(*words).stderr


def test_a_clock_that_is_ahead_lowers_a_track_without_elevations(tmp_path):
    words = walked(tmp_path, [[0, 0, 8], [60, 0, 8], [30, 50, 8]], 20)
    assert command(*words).stderr == ""
    wrong_log(tmp_path, tmp_path, linear(1.0, "toa_s", offset=2e-8))
    assert "warning: height: found -" in command(*words).stderr
    assert "No hypothesis" in command(*words, "--diagnose").stdout
    assert "height" not in command(*words, "--height", -20).stderr


def test_a_diagnosis_reports_facts_about_the_log():
    shown, results = with_json("localize", *ride(RIDE / "log.csv", "--diagnose"))
    columns = read_columns(RIDE / "log.csv")
    times = np.unique(columns["time_s"])
    facts = results["facts"]
    assert facts["epochs"] == len(times) and facts["problems"] == []
    assert (facts["first_s"], facts["last_s"]) == (times[0], times[-1])
    assert facts["step_s"] == pytest.approx(np.median(np.diff(times)))
    for anchor, fact in enumerate(facts["anchors"], start=1):
        snr = columns["snr_db"][columns["anchor"] == anchor]
        assert fact["seen"] == np.isfinite(snr).sum()  # SNRs of unseen anchors are NaN
    assert "no problems in the file" in shown


OFF = {  # name -> mistake, words of the warning, key of the scene that corrects it
    "azimuths turned": (
        linear(1.0, *AZIMUTHS, offset=np.radians(4.0)),
        "azimuths are turned by 4.0",
        "bearing_deg",
    ),
    "a clock 50 ns ahead": (
        linear(1.0, "toa_s", offset=50e-9),
        "ranges are too long by 1[45].* m",
        "range_offset_m",
    ),
}


@pytest.mark.parametrize("name", OFF)
def test_an_error_that_all_links_share_is_warned_of_and_corrected(tmp_path, name):
    mistake, words, key = OFF[name]
    log = wrong_log(tmp_path, RIDE, mistake)
    done = command("localize", *ride(log, "--speed", "auto"))
    (warning,) = [line for line in done.stderr.splitlines() if "looks as if" in line]
    assert re.search(f"as if {words}", warning) and "protection levels do not hold" in warning
    scene = tmp_path / "corrected.json"
    shown = succeed("localize", *ride(log, "--diagnose", "--write", scene))
    assert "consistent as it is" not in shown and f'write "{key}": ' in shown
    assert json_in(scene).keys() - json_in(RIDE / "scene.json").keys() == {key}
    done = command("localize", *ride(log, "--speed", "auto", "--scene", scene))
    assert done.returncode == 0 and done.stderr == ""


def test_innovations_are_small_without_a_warning_if_their_errors_last():
    done = command("localize", *ride(RIDE / "log.csv", "--speed", "auto", "--correlation", 20))
    assert done.returncode == 0 and done.stderr == ""


@pytest.mark.slow
def test_a_log_can_be_diagnosed_with_a_clock_and_a_scene_without_errors_is_not_written(tmp_path):
    scene = tmp_path / "corrected.json"
    words = ride(RIDE / "log.csv", "--diagnose", "--clock", "offset", "--write", scene)
    assert "Not written: nothing is wrong." in succeed("localize", *words)
    assert not scene.exists()


@pytest.mark.slow
@pytest.mark.parametrize("receiver", [dict, differences], ids=["times", "differences"])
def test_a_log_can_be_diagnosed_with_a_free_clock(tmp_path, receiver):
    log = wrong_log(tmp_path, RIDE, receiver)
    shown = succeed("localize", *ride(log, "--diagnose", "--clock", "free"))
    assert "The log is consistent as it is." in shown
