"""mmwave-loc doctor: sound kernels pass, a wrong one does not, and what is missing is named."""

import json
import os
import stat
import sys
from importlib import metadata

import numpy as np
import pytest

from experiments.evaluation.text import escaped
from experiments.health import self_test
from mmwave_env.compiler import disk_cache
from tests.cli import command, succeed


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    path = tmp_path_factory.mktemp("doctor") / "doctor.json"
    return succeed("doctor", "--json", path), json.loads(path.read_text())


def test_every_kernel_is_what_its_twin_is(told):
    text, figures = told
    tests = figures["self_test"]
    assert len(tests) == 8 and text.count("| passed |") == 8
    assert all(one["passed"] and one["deviation"] < 1e-9 for one in tests)
    assert {"filterpy", "floats", "numpy", "numpy's SFC64"} <= {one["twin"] for one in tests}


def test_versions_and_the_folder_of_compiled_functions_are_told(told):
    text, figures = told
    assert figures["machine"]["Python"].startswith(".".join(map(str, sys.version_info[:3])))
    used = [one for one in figures["compiled_functions"] if one["used"]]
    folder = disk_cache._folder()
    assert [one["place"] for one in used] == [str(folder.parent)]
    assert escaped(str(folder.parent)) in text
    assert int(used[0]["mode"], 8) == stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert used[0]["functions"] == len(list(folder.iterdir())) > 0


@pytest.mark.slow
def test_every_extra_has_a_row_and_what_is_missing_a_cure(monkeypatch, told):
    _, figures = told
    extras = set(metadata.metadata("mmwave-loc").get_all("Provides-Extra"))
    ours = {one["extra"] for one in figures["packages"]}
    assert ours - {""} == extras
    found = metadata.version

    def version(name):
        if name == "filterpy":
            raise metadata.PackageNotFoundError(name)
        return found(name)

    monkeypatch.setattr("experiments.health.installed.version", version)
    text = succeed("doctor")
    assert "| filterpy>=2 | pip install 'mmwave-loc[filterpy]' |" in text
    assert "tracks of EKF" not in text  # whose twin is not there


@pytest.mark.slow
def test_a_kernel_that_computes_something_else_fails(monkeypatch):
    smooth = self_test.smooth

    def wrong(*given):
        x, P = smooth(*given)
        return x + 1e-4, P

    monkeypatch.setattr(self_test, "smooth", wrong)
    done = command("doctor")
    assert done.returncode == 1 and "| FAILED |" in done.stdout
    assert "smoother: found other numbers than those of independent twins" in done.stderr


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_does_not_pass(value):
    assert not self_test.Check("kernel", "twin", value).passed


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="without owners")
def test_folders_of_others_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_cache.numba.config, "CACHE_DIR", str(tmp_path))
    planted = tmp_path / f"{disk_cache._PACKAGE.name}-0123"
    planted.mkdir()
    planted.chmod(0o777)
    (first, *_) = disk_cache.kept_functions()
    assert (first.place, first.used, first.doubtful) == (tmp_path, False, 1)
