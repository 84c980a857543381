"""The envelope's rim: just within it the textbook's numbers, just outside refused by name."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from experiments.reliability import extremes
from experiments.reliability.extremes import QUANTITIES
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.modes import Mode
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.cli import assert_one_clear_line, command, succeed
from tests.filters import textbook
from tests.filters.tracks import HZ_PER_MPS, STREET, pipeline_of, process_noise, track, unpacked

EPOCHS = 3


def ordinary():
    """An episode in which all is seen."""
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=EPOCHS)
    episode = source.sample(np.random.default_rng(3))
    seen = np.ones_like(episode.visible)
    return replace(episode, visible=seen, doppler_spread_hz=np.zeros(EPOCHS))


rims = pytest.mark.parametrize(
    ("quantity", "value"),
    [pytest.param(q, v, id=f"{q.name} {v:g}") for q in QUANTITIES for v in q.within],
)
outside = pytest.mark.parametrize(
    ("quantity", "value"),
    [pytest.param(q, v, id=f"{q.name} {v:g}") for q in QUANTITIES for v in q.beyond],
)


def expected_track(moments, mode, episode):
    """x (T, 7) and P (T, 7, 7) of the textbook, ungated."""
    sensor = textbook.Sensor(episode.scene_anchors_m, episode.hz_per_mps)
    x, P, found = episode.prior_mean, episode.prior_covariance, []
    for t, dt in enumerate(np.diff(episode.time_s, prepend=episode.time_s[0])):
        Q = noise_over(mode, dt, episode.hz_per_mps)
        x, P = textbook.predict(x, P, Q, dt)
        everything = np.ones(len(sensor.groups), bool)
        after = textbook.update(
            moments, sensor, sensor.groups, sensor.links, x, P, episode.measurement[t],
            episode.sigma[t] ** 2, everything,
        )  # fmt: skip
        x, P = after.x, 0.5 * (after.P + after.P.T)
        found.append((x, P))
    return tuple(map(np.array, zip(*found, strict=True)))


def noise_over(mode, dt, hz_per_mps):
    """Q over dt from that over a second (tests/filters/tracks.py)."""
    Q = process_noise(mode)
    velocity = np.diag(Q)[3:6]
    position = np.diag(Q)[:3] - velocity / 4.0
    out = np.diag([*(position * dt + velocity * dt**3 / 4.0), *velocity * dt, Q[6, 6] * dt])
    out[6, 6] *= (hz_per_mps / HZ_PER_MPS) ** 2
    for axis in range(3):
        out[axis, axis + 3] = out[axis + 3, axis] = velocity[axis] * dt**2 / 2.0
    return out


@rims
@pytest.mark.parametrize("algorithm", ["ekf", "ukf", "ckf"])
def test_just_within_the_envelope_updates_are_the_textbooks(quantity, value, algorithm):
    episode = quantity.put(ordinary(), value)
    pipeline = pipeline_of(STREET, [algorithm], gate=None, adaptive=False, sigma_v=0.5)
    ours = track(pipeline, [episode], 0, EPOCHS, ("x", "P"), on_floats=True)
    x, P = ours["x"][:, 0], unpacked(ours["P"])[:, 0]
    assert np.isfinite(x).all() and np.isfinite(P).all()
    expected = expected_track(textbook.METHODS[algorithm], pipeline.modes[0], episode)
    sigma = np.sqrt(np.einsum("...ii->...i", P))
    assert (sigma > 0.0).all()
    # the textbook's own rounding: it subtracts covariances, and inverts S with all its rows
    step = abs(x - episode.prior_mean)
    assert (abs(x - expected[0]) <= 0.02 * sigma + 1e-9 * step).all()
    scale = sigma[:, :, None] * sigma[:, None]
    np.testing.assert_allclose((P - expected[1]) / scale, 0.0, atol=0.02)


@outside
def test_just_outside_of_the_envelope_an_episode_is_refused_by_name(quantity, value):
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="expected ") as refusal:
        quantity.put(ordinary(), value)
    assert "of episode '" in str(refusal.value)
    if np.isfinite(value) and abs(value) < 1e100:
        assert quantity.bound.expected in str(refusal.value)


@pytest.mark.parametrize("name", [*extremes.QUIET, "spread_gain"])
@pytest.mark.parametrize("value", [-0.1, 30.1, 1e150, np.nan])
def test_a_mode_with_noise_beyond_the_envelope_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} of mode 'loud': .* a number of 0 to 30$"):
        Mode("loud", **{name: value})


@pytest.mark.parametrize("dt", [0.0, 61.0, 1e7, 1e12, np.inf, np.nan])
def test_a_step_of_minutes_is_refused_before_anything_is_drawn(dt):
    with pytest.raises(ValueError, match=r"^dt: found .*, expected a number of 1e-30 to 60 s$"):
        SimulatedSource(SCENES["street"], RADIOS["handset"], dt=dt)


def test_a_negative_doppler_spread_is_refused():
    put = partial(replace, ordinary(), doppler_spread_hz=np.array([0.0, -1.0, 0.0]))
    with pytest.raises(ValueError, match="doppler_spread_hz of episode 'cyclist': found -1, exp"):
        put()


# --- the command


@pytest.fixture
def one_mode(monkeypatch):
    monkeypatch.setattr(extremes, "modes", lambda: iter([Mode("plain")]))


def test_the_campaign_finds_nothing_and_tells_how_much_was_tried(one_mode, tmp_path, capsys):
    extremes.main(extremes.Args(epochs=5, json=tmp_path / "found.json"))
    found = json.loads((tmp_path / "found.json").read_text())["found"]
    assert found["within"] == found["sound"] > 400
    assert found["beyond"] == found["refused"] > 100 and found["failures"] == []
    assert f"| {found['within']:,} | {found['sound']:,} | - | 0 |" in capsys.readouterr().out


def test_the_campaign_fails_where_a_belief_is_no_number_or_an_extreme_is_let_through(
    one_mode, monkeypatch, capsys
):
    let_through = replace(QUANTITIES[0], name="whatever", put=lambda episode, value: episode)
    monkeypatch.setattr(extremes, "QUANTITIES", (*QUANTITIES[1:], let_through))
    monkeypatch.setattr(extremes, "sound", lambda x, P: np.arange(len(x)) != 7)
    with pytest.raises(SystemExit) as left:
        extremes.main(extremes.Args(epochs=2))
    assert left.value.code == 1
    shown = capsys.readouterr().out
    assert "plain: " in shown and "whatever 60.6: accepted" in shown


@pytest.mark.slow
def test_modes_of_every_kind_are_sound_within_the_envelope():
    assert "| 0 |" in succeed("extremes")


def test_a_track_of_no_length_is_refused():
    assert_one_clear_line(
        command("extremes", "--epochs", "1"), "epochs: found 1, expected at least 2"
    )
