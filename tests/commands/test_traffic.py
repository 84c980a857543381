"""mmwave-loc traffic: SUMO's programs in a row, where they are installed."""

import importlib.util
import sys

import pytest

from mmwave_env.episodes.fcd import SUFFIXES, read_fcd
from tests.cli import assert_one_clear_line, command, succeed

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="needs the extra sumo"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "a.json"], "out: found a.json, expected a name in .xml, .xml.gz"),
        (["--out", "a.xml", "--seconds", 0], "seconds: found 0.0, expected a number > 0"),
        (["--out", "a.xml", "--vehicles", -1], "vehicles: found -1.0, expected a number > 0"),
        (["--out", "a.xml", "--blocks", 0], "blocks: found 0, expected at least 1"),
        (["--out", "a.xml", "--step", 1e-3], "step: found 0.001, expected 0.01 s to 300"),
    ],
)
def test_what_means_nothing_is_refused(tmp_path, words, message):
    assert_one_clear_line(command("traffic", *words, cwd=tmp_path), message)
    assert not list(tmp_path.iterdir())


def test_it_names_the_extra_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sumo", None)  # as if it were not installed
    done = command("traffic", "--out", tmp_path / "new.xml")
    assert_one_clear_line(done, r"traffic needs sumo: pip install 'mmwave-loc\[sumo\]'")
    assert not list(tmp_path.iterdir())


SMALL = ("--seconds", 40, "--step", 1, "--blocks", 1, "--block-m", 100, "--vehicles", 6,
         "--pedestrians", 6)  # fmt: skip


@needs_sumo
@pytest.mark.slow
def test_the_same_seed_gives_the_same_traffic_in_every_format(tmp_path):
    pytest.importorskip("pyarrow")
    made = []
    for suffix in SUFFIXES:
        path = tmp_path / f"traffic{suffix}"
        said = succeed("traffic", "--out", path, "--seed", 3, *SMALL)
        made.append(read_fcd(path, lambda name, kind: True))
        assert f"written to {path}: {len(made[-1])} trips (made by SUMO)" in said
    assert {trip.kind for trip in made[0]} == {"DEFAULT_VEHTYPE", "DEFAULT_PEDTYPE"}
    for other in made[1:]:
        assert [trip.name for trip in other] == [trip.name for trip in made[0]]
        for one, two in zip(made[0], other, strict=True):
            assert one.position_m.tolist() == two.position_m.tolist()
            assert one.time_s.tolist() == two.time_s.tolist()


@needs_sumo
@pytest.mark.slow
def test_what_is_made_is_a_scenario(tmp_path):
    succeed("traffic", "--out", "t.xml.gz", "--seed", 1, *SMALL, cwd=tmp_path)
    said = succeed("simulate", "--scenario", "t.xml.gz", "--episode-steps", 10, "--out", "ride",
                   cwd=tmp_path)  # fmt: skip
    assert " of t.xml.gz" in said and "trips, moved by (" in said
    assert (tmp_path / "ride" / "truth.tum").exists()


@needs_sumo
@pytest.mark.slow
def test_what_sumo_refuses_is_told_in_a_line(tmp_path):
    words = ("--out", tmp_path / "t.xml", "--block-m", 1e-6, "--seconds", 10)
    assert_one_clear_line(command("traffic", *words), "netgenerate of SUMO failed: Error: ")
    assert not list(tmp_path.iterdir())
