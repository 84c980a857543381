"""Test of the output and the files of ``mmwave-loc demo``, with invented scores of all policies."""

import numpy as np

from experiments import demo
from experiments.evaluation.compare import compare_scores
from experiments.evaluation.contenders import contenders
from experiments.evaluation.positions import EpochErrors
from mmwave_env.metrics import METRICS, TERMS
from tests.paths import json_in


def test_results_for_every_data_set_are_printed_and_written(tmp_path, monkeypatch, capsys):
    everyone = [*contenders("handset")]

    def results(args):
        assert args.percentiles and not args.policies
        scores = {name: dict.fromkeys((*METRICS, *TERMS), np.arange(3.0)) for name in everyone}
        episodes = {"scenario": args.data or "mixed", "seeds": range(args.episodes)}
        comparison = compare_scores(scores, radio=args.radio, **episodes)
        return comparison, str(comparison), comparison.json, EpochErrors()

    def page_of(args):
        assert args.results == tuple(tmp_path / f"{data}.json" for data in data_sets)
        return "a page"

    data_sets = ["mixed", "canyon28_pedestrian", "canyon28_vehicle"]
    monkeypatch.setattr("experiments.reporting.comparison_results.results", results)
    monkeypatch.setattr("experiments.reporting.webpage.page.page_of", page_of)
    demo.main(demo.Args(out=tmp_path, percentiles=True))
    shown = capsys.readouterr().out
    assert "Paired" not in shown and str(tmp_path / "tables.md") in shown
    written = (tmp_path / "tables.md").read_text()
    assert all(written.count(f"\n| {name} |") == 2 * len(data_sets) for name in everyone)
    assert all(shown.count(f"\n| {name} |") == len(data_sets) for name in everyone)
    (page,) = tmp_path.glob("*.html")
    assert str(page) in shown and page.read_text() == "a page"
    for data in data_sets:
        assert str(tmp_path / f"{data}.json") in shown
        assert list(json_in(tmp_path / f"{data}.json")["policies"]) == everyone
