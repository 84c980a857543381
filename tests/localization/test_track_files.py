"""Tests of writing tracks as TUM files, each with a CSV table beside it."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.localization.localizer import Track
from mmwave_env.localization.position_errors import gaussian_levels
from mmwave_env.localization.track_files import require_own_files, table_beside, write_track
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import SCENES
from tests.localization.test_position_errors import covariances
from tests.logs.by_hand import log_with
from tests.refusals import refuses

NAMES = ['fast, "wild"', '=HYPERLINK("http://evil","x")']  # names of modes
SHOWN = [NAMES[0], "'" + NAMES[1]]  # names in the table; the apostrophe disables the formula
SCENE = SCENES["street"]
KINDS = ("horizontal", "vertical")


def some_track(epochs, seed=0):
    """Return a track of random numbers, in arrays with the shapes of a real track."""
    rng = np.random.default_rng(seed)
    x = 100.0 * rng.standard_normal((epochs, 7))
    P = covariances(epochs, seed=seed)
    groups = rng.random((epochs, 4)) < 0.8
    time_s = 1.7e9 + np.arange(epochs) / 3.0
    log = log_with(Layout(3), time_s, np.zeros((epochs, 13)), groups)
    trusted = np.full(epochs, np.nan)
    return Track(
        **vars(log),
        x=x,
        P=P,
        smooth_x=x + 1.0,
        smooth_P=2.0 * P,
        mode=rng.integers(2, size=epochs),
        modes=NAMES,
        nis=rng.random((epochs, 4)),
        accepted=groups,
        segment=np.zeros(epochs, int),
        skipped=0,
        dropped=0,
        planar=False,
        trusted=trusted,
        smooth_trusted=trusted,
        level_factors=1.0 + rng.random((epochs, 2)),
    )


def test_a_track_and_its_table_replace_only_files_of_their_kind(tmp_path):
    out = tmp_path / "trip.tum"
    table = tmp_path / "trip.csv"
    for _ in range(2):  # the second track replaces the first
        require_own_files(out)
        write_track(some_track(2), [out], SCENE)
    for path, others in (
        (table, (b"t,x,y,z\n0,1,2,3\n", b"\xff\xfe", b"")),
        (out, (b"# t x y z qx qy qz qw; mmwave-loc simulate\n", b"0 1 2 3 0 0 0 1\n", b"")),
    ):
        for other in others:
            path.write_bytes(other)
            with refuses("out"):
                require_own_files(out)
        path.unlink()


@pytest.mark.parametrize("trusted", [np.nan, 0.25])
def test_a_track_is_written_as_tum_and_as_a_table(tmp_path, trusted):
    track = replace(some_track(9), trusted=np.full(9, trusted))
    out = tmp_path / "new" / "walk.v2.tum"
    write_track(track, [out], SCENE)
    assert sorted(path.name for path in out.parent.iterdir()) == ["walk.v2.csv", "walk.v2.tum"]
    x = track.smooth_x
    P = track.smooth_P
    written = read_tum(out)
    assert_array_equal(written.time_s, track.time_s)
    assert_array_equal(written.position_m, x[:, :3])
    with table_beside(out).open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    assert columns.pop("mode") == tuple(SHOWN[m] for m in track.mode)
    numbers = {name: np.array(values, float) for name, values in columns.items()}
    assert_array_equal(numbers.pop("time_s"), track.time_s)
    diagonal = np.sqrt(P[:, [0, 2, 5, 9, 14, 20]])
    for i, name in enumerate(("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")):
        assert_allclose(numbers.pop(name), x[:, i], atol=1e-6)
        assert_allclose(numbers.pop(f"sigma_{name}"), diagonal[:, i], rtol=1e-5)
    levels = gaussian_levels(P, 1e-3) * track.level_factors
    for kind, level in zip(KINDS, levels.T, strict=True):
        assert_allclose(numbers.pop(f"{kind}_level_m"), level, rtol=1e-5)
    assert [*numbers] == ([] if np.isnan(trusted) else ["trusted"])


def test_only_tum_files_have_a_table_and_unknown_endings_are_refused():
    assert table_beside(Path("a/walk.tum")) == Path("a/walk.csv")
    assert table_beside(Path("walk.csv")) is table_beside(Path("walk.gpx")) is None
    for name in ("walk.kml", "walk", "/dev/stdout"):
        with refuses("out"):
            table_beside(Path(name))
