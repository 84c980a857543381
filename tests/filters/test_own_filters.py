"""Tests that the filter in docs/own-filters.md works as shown, wherever modes are accepted."""

import importlib
import re
import sys
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from experiments.evaluation.contenders import contender_from
from experiments.evaluation.runner import score_contenders
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.custom import AlgorithmError
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.filters import gated_textbook
from tests.filters.problems import GATES, assert_same, assume_clear_of, problems
from tests.filters.tracks import STREET, sampled, street_source
from tests.logs.by_hand import write_log
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "own-filters.md").read_text()
IEKF, _, HASTY, *_ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module", autouse=True)
def files(tmp_path_factory):
    """Write the page's files to a folder from which they can be imported."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "iekf.py").write_text(IEKF)
    (folder / "hasty.py").write_text(HASTY)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield folder
    for name in ("iekf", "hasty"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def iekf(files):
    return importlib.import_module("iekf").iekf


@pytest.mark.parametrize("odometry", [False, True], ids=["radio", "odometry"])
@pytest.mark.parametrize("gate", GATES, ids=str)
@pytest.mark.parametrize("iterations", [1, 3])
@given(data=st.data())
@settings(max_examples=15)
def test_the_iekf_equals_the_textbook(iekf, iterations, gate, odometry, data):
    problem = data.draw(problems(odometry))
    s = problem.sensor
    expected = gated_textbook.iterated(iterations, s, *problem.update, gate)
    assume_clear_of(expected.nis, s, gate.quantile)
    assert_same(problem.ours(partial(iekf, iterations=iterations), gate), expected)


def test_a_custom_filter_can_localize_the_user_of_a_log(iekf, tmp_path):
    scene = SCENES["street"]
    episode = sampled(street_source(epochs=30))
    write_log(tmp_path / "log.csv", episode)
    tracks = []
    for algorithm in (partial(iekf, iterations=1), "ekf"):
        switching = Switching((Mode("m", algorithm),))
        log = read_log(tmp_path / "log.csv", scene).whole()
        tracks.append(localize(log, scene, RADIOS["handset"], switching))
    own, ours = tracks
    assert_allclose(own.smooth_x, ours.smooth_x, rtol=1e-6, atol=1e-6)


def test_a_custom_filter_is_evaluated_like_a_shipped_mode(iekf):
    mine = Mode("iekf", iekf, sigma_v=1.8)
    source = street_source(epochs=30)
    both = [contender_from(name, "handset", (mine,)) for name in ("fixed-iekf", "imm")]
    scores = score_contenders(both, source, range(2))
    assert np.isfinite(scores["fixed-iekf"]["ate_m"]).all()
    assert_allclose(scores["imm"]["ate_m"], scores["fixed-iekf"]["ate_m"], rtol=1e-6)


def test_the_hasty_filter_is_refused_with_the_message_that_the_page_shows(files):
    hasty = importlib.import_module("hasty").hasty
    (shown,) = re.findall(r"```\n(algorithm hasty.*?)```", PAGE, re.DOTALL)
    with pytest.raises(AlgorithmError) as refusal:
        Pipeline((Mode("hasty", hasty),), STREET)
    assert str(refusal.value).replace(f"{files}/", "") == shown
