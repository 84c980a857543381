"""Tests of the tables that reproduce the paper: their scores, their sections, and their page."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.evaluation.contenders import contender_from
from experiments.evaluation.runner import score
from experiments.paper.claims import contradictions, resolution
from experiments.paper.printed import Bench, Setting, track
from experiments.tables import FIELDS
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.smoothing import SMOOTHED, smooth
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import default_modes
from tests.cli import succeed
from tests.filters.tracks import nees_of
from tests.pages import blocks_of, made
from tests.paths import ROOT, numbers, records

PEDESTRIAN = Setting("pedestrian", "handset")


@pytest.fixture(scope="module")
def bench():
    return Bench(6, seed=3)


def test_filtered_scores_equal_the_scores_of_an_evaluation(bench):
    scores = bench.run(default_modes("handset")[0], PEDESTRIAN).filtered.scores
    contender = contender_from("fixed-ekf", "handset")
    episodes = bench.episodes(PEDESTRIAN)
    expected = score(contender, episodes)
    for metric, values in scores.items():
        assert_allclose(values, expected[metric], rtol=1e-9)


@pytest.mark.parametrize("planar", [False, True])
def test_smoothed_scores_equal_scores_computed_from_the_smoothed_track(bench, planar):
    episodes = bench.episodes(PEDESTRIAN)
    mode = default_modes("handset")[0]
    smoothed = track(mode, episodes, planar).smoothed
    tracker = Engine(Pipeline((mode,), episodes[0].layout, planar), len(episodes), observation="")
    tracker.load(episodes)
    tracks = tracker.run(SMOOTHED)[SMOOTHED]
    steps = np.diff([episode.time_s for episode in episodes], prepend=0.0)
    x, P = smooth(tracker.pipeline, tracks, steps, episodes[0].hz_per_mps)
    axes = 2 if planar else 3
    error = (x[..., :3] - np.stack([e.truth_position_m for e in episodes]))[:, 10:]
    assert_allclose(smoothed.nees, nees_of(error[..., :axes], P[:, 10:]), rtol=1e-6)
    ate = np.linalg.norm(error, axis=-1).mean(axis=1)
    assert_allclose(smoothed.scores["ate_m"], ate, rtol=1e-9)


def test_a_run_keeps_its_errors_alone(bench):
    mode = default_modes("handset")[0]
    episodes = bench.episodes(PEDESTRIAN)
    track(mode, episodes)  # compiles
    tracemalloc.start()
    run = track(mode, episodes)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 3 * (run.filtered.nees.nbytes + run.smoothed.nees.nbytes)


def test_a_clean_channel_has_no_biases():
    def worst(setting):
        for e in Bench(20, 0).episodes(setting):
            ranges = np.linalg.norm(e.truth_position_m - e.scene_anchors_m[0], axis=1)
            yield (np.abs(e.measurement[:, 0] - ranges) / e.sigma[:, 0])[e.usable[:, 0]].max()

    assert max(worst(replace(PEDESTRIAN, clean=True))) < 6.0 < max(worst(PEDESTRIAN))


def test_sections_that_need_no_tracks_have_the_expected_rows(bench):
    rows = {row[0]: row for row in contradictions(bench).rows}
    assert len(rows) == 6 and rows["Table II, UKF"][-1] == "RPE > 2 ATE"
    section = resolution(bench)
    bounds = [row[1] for row in section.rows]
    assert_allclose(np.array(bounds[:-1]) / bounds[1:], 10**0.5, rtol=1e-6)
    # With the bandwidth B = 100 MHz, the bound at 0 dB is c / (2 pi (B / sqrt(12)) sqrt(2)).
    assert bounds[0] == pytest.approx(299792458.0 / (2e8 * np.pi / 12**0.5 * 2**0.5))
    assert "c / B is 3.00 m" in section.note


PAGE = ROOT / "docs" / "paper.md"


def tables_of_the_page(printed, folder):
    """Return the tables of the page, and the tables that replace them if it is renewed."""
    tables = [table for block in blocks_of(PAGE) for table in block.tables]
    assert len(tables) == 4
    return "".join(t["shown"] for t in tables), "".join(made(t, printed, folder) for t in tables)


@pytest.mark.slow
@pytest.mark.release
def test_the_page_is_what_the_command_prints(tmp_path):
    shown, now = tables_of_the_page(succeed("tables", "--out", tmp_path), tmp_path)
    assert re.sub(r"\d", "", now) == re.sub(r"\d", "", shown)
    # Other processors round differently, which matters only in the few rows with lost tracks.
    assert np.isclose(numbers(now), numbers(shown), rtol=0.03, atol=0.005).mean() > 0.99
    now = records(tmp_path / "tables.csv")
    shown = records(PAGE.with_suffix(".csv"))
    assert [record["row"] for record in now] == [record["row"] for record in shown]
    means = [[float(record["mean"]) for record in some] for some in (now, shown)]
    assert np.isclose(*means, rtol=0.03, atol=0.005).mean() > 0.99


@pytest.mark.slow
def test_the_command_writes_tables(tmp_path):
    printed = succeed("tables", "--episodes", "10", "--out", tmp_path)
    shown, now = tables_of_the_page(printed, tmp_path)
    assert now.count("\n") == shown.count("\n") and now != shown
    written = records(tmp_path / "tables.csv")
    assert tuple(written[0]) == FIELDS and len(written) > 500
    for record in written:
        if record["low"]:
            assert float(record["low"]) <= float(record["mean"]) <= float(record["high"])
    assert (tmp_path / "tables.md").read_text().strip() in printed
