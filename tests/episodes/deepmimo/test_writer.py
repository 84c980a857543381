import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.deepmimo.writer import write_deepmimo
from mmwave_env.episodes.recorded import RecordedSource, Recording
from mmwave_env.episodes.samples import recording_from, sample_names
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.models.measurement import SPEED_OF_LIGHT, Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES, Scene, Wall
from tests.filters.tracks import geometry

pytestmark = pytest.mark.slow  # all together half a minute

# What float32 leaves of a street of 1 km: m; rad; dB.
RANGE_M, GAIN_DB, ANCHOR_M = 1e-4, 1e-5, 1e-3
ARRIVAL_RAD, DEPARTURE_RAD = 2e-6, 1e-4  # departures are mirrored in walls that are read back, too
LINK = "t000_tx000_r001"


def recording(scene, position, velocity, visible, gain_db=-90.0):
    """What a perfect receiver measures along a track (T, 3) of links (T, L) that are visible."""
    T, L = visible.shape
    rows = geometry(position, velocity, scene, Layout(L))[:, : 4 * L].reshape(T, L, 4)
    rows[~visible] = np.nan
    return Recording.from_arrays(
        time_s=0.5 * np.arange(T), anchors_m=scene.anchors_m, range_m=rows[..., 0],
        aoa_azimuth_rad=rows[..., 1], aoa_elevation_rad=rows[..., 2],
        aod_azimuth_rad=rows[..., 3], path_gain_db=np.where(visible, gain_db, np.nan),
        position_m=position, velocity_mps=velocity, carrier_hz=scene.carrier_hz,
        bandwidth_hz=scene.bandwidth_hz, name=scene.name,
    )  # fmt: skip


def straight(scene=SCENES["street"], visible=None):
    """A user that goes along the street of a scene."""
    T = 12
    position = np.column_stack([np.linspace(20, 70, T), np.zeros(T), np.full(T, 1.5)])
    velocity = np.tile([50 / (T - 1) / 0.5, 0, 0], (T, 1))
    L = len(scene.anchors_m)
    return recording(
        scene, position, velocity, np.ones((T, L), bool) if visible is None else visible
    )


def assert_read_back(written, read):
    """The same track, and the same links to the anchors that were ever seen."""
    assert read.carrier_hz == written.carrier_hz
    for field in ("time_s", "position_m", "velocity_mps"):
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field))
    L = written.layout.anchors
    seen = [a for a in range(L) if written.visible[:, a].any()]
    assert read.layout.anchors == len(seen)
    for a in seen:
        far = np.linalg.norm(read.anchors_m - written.anchors_m[a], axis=1)
        b, at = int(far.argmin()), written.visible[:, a]
        assert far[b] < ANCHOR_M
        np.testing.assert_array_equal(read.visible[:, b], at)
        error = (
            read.measurement[at, read.layout.link(b)]
            - written.measurement[at, written.layout.link(a)]
        )
        error[:, 1:] = np.remainder(error[:, 1:] + np.pi, 2 * np.pi) - np.pi
        # Straight below an anchor the azimuth turns fast.
        rows = written.measurement[at, written.layout.link(a)]
        error[:, [1, 3]] *= np.cos(rows[:, 2])[:, None]
        assert np.abs(error[:, 0]).max() < RANGE_M
        assert np.abs(error[:, 1:3]).max() < ARRIVAL_RAD
        assert np.abs(error[:, 3]).max() < DEPARTURE_RAD
        gain = read.path_gain_db[at, b] - written.path_gain_db[at, a]
        assert np.abs(gain).max() < GAIN_DB
    sight = written.visible[:, L]
    np.testing.assert_array_equal(read.visible[:, -1], sight)
    shift = read.measurement[sight, -1] - written.measurement[sight, written.layout.doppler]
    assert np.abs(shift).max(initial=0.0) < 0.05  # Hz: the base station's position is rounded


def load(folder, key, link=LINK):
    with np.load(folder / f"{key}_{link}.npz") as file:
        return file[key]


coordinates = st.floats(-300.0, 300.0)


@st.composite
def recordings(draw):
    """A user in front of up to three walls, who sees some of the links."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    gnb = np.array([draw(coordinates), draw(coordinates), draw(st.floats(3.0, 40.0))])
    T = draw(st.integers(2, 12))
    start = np.array([draw(coordinates), draw(coordinates), draw(st.floats(0.5, 2.5))])
    velocity = np.tile([*rng.uniform(-20, 20, 2), 0.0], (T, 1))
    position = start + 0.5 * np.arange(T)[:, None] * velocity
    walls = []
    for turn in np.cumsum(rng.uniform(0.5, 1.5, draw(st.integers(0, 3)))):
        normal = np.array([np.cos(turn), np.sin(turn)])
        furthest = (np.vstack([position, gnb])[:, :2] @ normal).max()
        walls.append(Wall(tuple(normal.tolist()), float(furthest + rng.uniform(2.0, 100.0))))
    visible = rng.random((T, 1 + len(walls))) < draw(st.floats(0.2, 1.0))
    visible[rng.integers(T), 0] = True  # without a line of sight, a scenario is refused
    scene = Scene("drawn", tuple(gnb.tolist()), tuple(walls))
    return recording(scene, position, velocity, visible, rng.uniform(-150.0, -60.0, visible.shape))


@settings(max_examples=25, deadline=None)
@given(recordings())
def test_what_is_written_is_read_back(tmp_path_factory, drawn):
    folder = tmp_path_factory.mktemp("scenario")
    write_deepmimo(folder, drawn)
    assert_read_back(drawn, read_deepmimo(folder, virtual_anchors=3))


@pytest.mark.parametrize("scene", [*SCENES.values(), RandomScene()], ids=lambda scene: scene.name)
@pytest.mark.parametrize("scenario", ["pedestrian", "vehicle"])
def test_simulated_episodes_are_read_back(tmp_path, scene, scenario):
    source = SimulatedSource(scene, RADIOS["handset"], scenario, epochs=60)
    episode = source.episode(5)
    written = Recording.of_episode(episode, source.scene_of(5), source.radio)
    np.testing.assert_array_equal(written.visible[:, :3], episode.usable[:, :3])
    np.testing.assert_array_equal(written.position_m, episode.truth_position_m)
    write_deepmimo(tmp_path, written)
    assert_read_back(written, read_deepmimo(tmp_path))


@pytest.mark.parametrize("name", sample_names())
def test_a_ray_traced_recording_is_read_back(tmp_path, name):
    recorded = recording_from(name)
    write_deepmimo(tmp_path, recorded)
    again = read_deepmimo(tmp_path)
    np.testing.assert_array_equal(again.visible, recorded.visible)
    np.testing.assert_allclose(again.anchors_m, recorded.anchors_m, atol=1e-4)


def test_an_episode_of_a_recording_is_that_recording_again():
    recorded, radio = recording_from("canyon28_vehicle"), RADIOS["standard"]
    episode = RecordedSource(recorded, radio).sample(np.random.default_rng(3))
    again = Recording.of_episode(episode, recorded.scene, radio)
    np.testing.assert_array_equal(again.visible, recorded.visible)
    seen = recorded.visible[:, :3]
    np.testing.assert_allclose(again.path_gain_db[seen], recorded.path_gain_db[seen], rtol=1e-12)
    rows = np.repeat(recorded.visible, [4, 4, 4, 1], axis=1)
    np.testing.assert_allclose(again.measurement[rows], recorded.measurement[rows], atol=1e-4)


def test_paths_bounce_as_light_does(tmp_path):
    scene = SCENES["street"]
    write_deepmimo(tmp_path, straight(scene))
    position, (station,) = load(tmp_path, "rx_pos"), load(tmp_path, "tx_pos")
    inter, bounce = load(tmp_path, "inter"), load(tmp_path, "inter_pos")[:, :, 0]
    np.testing.assert_array_equal(inter, np.tile([0, 1, 1], (12, 1)))
    assert np.isnan(bounce[:, 0]).all()
    length = SPEED_OF_LIGHT * load(tmp_path, "delay").astype(float)
    np.testing.assert_allclose(length[:, 0], np.linalg.norm(position - station, axis=1), atol=1e-4)
    for k, wall in enumerate(scene.walls, start=1):
        q = bounce[:, k]
        np.testing.assert_allclose(wall.signed_distance(q.T), 0.0, atol=1e-4)
        out, back = q - station, position - q
        way = np.linalg.norm(out, axis=1) + np.linalg.norm(back, axis=1)
        np.testing.assert_allclose(length[:, k], way, atol=1e-4)
        for of, vector in (("aod", out), ("aoa", -back)):  # from the station; to where it came from
            azimuth, zenith = (np.radians(load(tmp_path, f"{of}_{e}")[:, k]) for e in ("az", "el"))
            unit = vector / np.linalg.norm(vector, axis=1, keepdims=True)
            np.testing.assert_allclose(np.cos(zenith), unit[:, 2], atol=1e-5)
            np.testing.assert_allclose(np.sin(zenith) * np.cos(azimuth), unit[:, 0], atol=1e-5)
            np.testing.assert_allclose(np.sin(zenith) * np.sin(azimuth), unit[:, 1], atol=1e-5)


def test_paths_that_are_there_come_first(tmp_path):
    visible = np.ones((12, 3), bool)
    visible[3] = [False, False, True]
    visible[4] = False
    write_deepmimo(tmp_path, straight(visible=visible))
    inter = load(tmp_path, "inter")
    np.testing.assert_array_equal(inter[3:5], [[1, np.nan, np.nan], [np.nan] * 3])
    for key in ("power", "phase", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el"):
        array = load(tmp_path, key)
        assert array.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(array), np.isnan(inter))


def test_stations_are_transmitters_of_their_own(tmp_path):
    written = straight()
    write_deepmimo(tmp_path, written, stations=True)
    for k, anchor in enumerate(written.anchors_m):
        link = f"t000_tx{k:03}_r001"
        np.testing.assert_allclose(load(tmp_path, "tx_pos", link), [anchor])
        assert (load(tmp_path, "inter", link) == 0).all()
    params = json.loads((tmp_path / "params.json").read_text())
    assert params["txrx_sets"]["txrx_set_0"]["num_points"] == 3
    assert_read_back(written, read_deepmimo(tmp_path))


def test_a_user_behind_a_wall_is_refused(tmp_path):
    stations = Scene("square", (0.0, 0.0, 8.0), virtual_anchors_m=((60.0, 5.0, 8.0),))
    with pytest.raises(ValueError, match="anchor 2 at .*user at 1.5 s .*stations=True"):
        write_deepmimo(tmp_path, straight(stations))
    assert not list(tmp_path.iterdir())
    write_deepmimo(tmp_path, straight(stations), stations=True)
    assert_read_back(straight(stations), read_deepmimo(tmp_path))


def test_rows_that_contradict_the_positions_are_refused(tmp_path):
    recorded = straight()
    recorded.measurement[2, 4] += 3.0
    with pytest.raises(ValueError, match=r"range_m of anchor 2 at 1 s.*as the positions say"):
        write_deepmimo(tmp_path, recorded)


def test_a_recording_without_truth_is_refused(tmp_path):
    nobody = replace(straight(), position_m=None)
    with pytest.raises(ValueError, match="found none, expected where the user was"):
        write_deepmimo(tmp_path, nobody)


def test_a_track_that_could_not_be_read_back_is_refused(tmp_path):
    with pytest.raises(ValueError, match="recording 'street': found 1 rows, expected at least 2"):
        write_deepmimo(tmp_path, straight().window(3, 1))
    slow = straight()
    with pytest.raises(ValueError, match="recording 'street', row 2: t: found 20, expected"):
        write_deepmimo(tmp_path, replace(slow, time_s=40.0 * slow.time_s))
    assert not list(tmp_path.iterdir())


def test_arrays_of_another_scenario_are_not_mixed_in(tmp_path):
    write_deepmimo(tmp_path, straight(), stations=True)
    with pytest.raises(ValueError, match="found aoa_az_t000_tx001_r001.npz of another scenario"):
        write_deepmimo(tmp_path, straight())
    write_deepmimo(tmp_path, straight(), stations=True)


def test_what_is_half_written_is_no_scenario(tmp_path, monkeypatch):
    write_deepmimo(tmp_path, straight())

    def full(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="disk full"):
        write_deepmimo(tmp_path, straight())
    with pytest.raises(FileNotFoundError, match=r"params\.json"):
        read_deepmimo(tmp_path)
