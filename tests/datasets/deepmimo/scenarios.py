"""Scenario folders for tests: shortened or damaged copies of shipped folders, and a simple hall."""

import shutil

import numpy as np
from numpy.testing import assert_allclose

from mmwave_env.models.layout import wrapped
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.filters.tracks import geometry
from tests.logs.by_hand import shown
from tests.paths import RECORDINGS, json_in, write_json

VEHICLE = RECORDINGS / "canyon28_vehicle"
PEDESTRIAN = RECORDINGS / "canyon28_pedestrian"
STATION = "t000_tx000"
LINK = f"{STATION}_r001"
OF_PATHS = ("power", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el", "inter", "inter_pos")
KEYS = ("rx_pos", "tx_pos", *OF_PATHS)
TRUTH = "trajectory.csv"


def load(folder, key, link=LINK):
    with np.load(folder / f"{key}_{link}.npz") as file:
        return file[key]


def store(folder, key, array, link=LINK):
    np.savez_compressed(folder / f"{key}_{link}.npz", **{key: array})


def edit(folder, key, change, link=LINK):
    """Change a stored array; ``change`` returns the new array or changes the array in place."""
    array = load(folder, key, link)
    changed = change(array)
    store(folder, key, array if changed is None else changed, link)


def set_at(index, value):
    """Return a change for :func:`edit` that sets elements of an array."""

    def change(array):
        array[index] = value

    return change


def edit_params(folder, change):
    """Change params.json; ``change`` changes its content in place."""
    file = folder / "params.json"
    params = json_in(file)
    change(params)
    write_json(file, params)


def set_counts(folder, receivers, scenes=1):
    """Set, in params.json, the number of receivers per scene and the number of scenes."""

    def change(params):
        params["txrx_sets"]["txrx_set_1"]["num_points"] = receivers
        params["scene"]["num_scenes"] = scenes

    edit_params(folder, change)


def edit_line(folder, number, line):
    """Replace a line of trajectory.csv (line 1 is the header), or drop it if ``line`` is None."""
    file = folder / TRUTH
    lines = file.read_text().splitlines()
    lines[number - 1 : number] = [] if line is None else [line]
    file.write_text("\n".join(lines) + "\n")


def shortened(folder, epochs, source=VEHICLE):
    """Write a folder with the first epochs of a recording."""
    folder.mkdir(parents=True)
    shutil.copy(source / "params.json", folder)
    set_counts(folder, epochs)
    lines = (source / TRUTH).read_text().splitlines()
    (folder / TRUTH).write_text("\n".join(lines[: epochs + 1]) + "\n")
    for key in KEYS:
        array = load(source, key)
        store(folder, key, array if key == "tx_pos" else array[:epochs])
    return folder


def dynamic_twin(static, folder, others=0):
    """Write a dynamic scenario with a scene for every receiver of a static scenario.

    The arrays of a scene have room only for the paths that occur in it. The last receiver of a
    scene is the user; ``others`` receivers before it stand still at the user's first position.
    """
    folder.mkdir()
    shutil.copy(static / TRUTH, folder)
    shutil.copy(static / "params.json", folder)
    arrays = {key: load(static, key) for key in KEYS}
    N = len(arrays["rx_pos"])
    set_counts(folder, others + 1, N)
    for n in range(N):
        scene = folder / f"scene_{n:04}"
        scene.mkdir()
        rows = [0] * others + [n]
        most = int(np.isfinite(arrays["inter"][rows]).sum(axis=1).max())
        for key, array in arrays.items():
            chosen = array if key == "tx_pos" else array[rows]
            store(scene, key, chosen[:, :most] if key in OF_PATHS else chosen)
    return folder


def reflect(point, normal, offset):
    """Return the mirror image of a point in a wall, the plane ``p @ normal == offset``."""
    return point - 2.0 * (point @ normal - offset)[..., None] * normal


def assert_fits(recording, scene, near_m=1e-6, near_rad=1e-5):
    """Assert that visible rows fit the geometry of a scene, within ``near_m`` and ``near_rad``."""
    layout = recording.layout
    exact = geometry(recording.position_m, recording.velocity_mps, scene, layout)
    difference = np.where(shown(recording), recording.measurement - exact, 0.0)
    assert_allclose(wrapped(difference[:, layout.angles]), 0.0, atol=near_rad)
    assert_allclose(difference[:, : layout.doppler : 4], 0.0, atol=near_m)
    assert_allclose(difference[:, layout.doppler], 0.0, atol=1e-9)


def rays(gnb, receivers, walls):
    """Trace a line of sight and, at each wall (normal, offset), a reflection.

    Returns:
        Unit vectors (2, N, P, 3) from the receivers and from the gNB, lengths (N, P) in m, and
        points of reflection (N, P, 3), which are NaN on the first path, the line of sight.
    """
    N = len(receivers)
    P = 1 + len(walls)
    aim = np.empty((2, N, P, 3))
    length = np.empty((N, P))
    bounce = np.full((N, P, 3), np.nan)
    aim[0, :, 0] = gnb - receivers
    aim[1, :, 0] = receivers - gnb
    length[:, 0] = np.linalg.norm(receivers - gnb, axis=1)
    for w, (normal, offset) in enumerate(walls, start=1):
        ray = reflect(gnb, normal, offset) - receivers
        q = receivers + ((offset - receivers @ normal) / (ray @ normal))[:, None] * ray
        aim[0, :, w] = q - receivers
        aim[1, :, w] = q - gnb
        bounce[:, w] = q
        length[:, w] = np.linalg.norm(ray, axis=1)
    return aim / np.linalg.norm(aim, axis=-1, keepdims=True), length, bounce


def write_hall(folder, gnb, receivers, walls, link=LINK):
    """Write a scenario of :func:`rays`."""
    (folder / "params.json").write_text((VEHICLE / "params.json").read_text())
    N = len(receivers)
    set_counts(folder, N)
    aim, length, bounce = rays(gnb, receivers, walls)
    for name, unit in zip(("aoa", "aod"), aim, strict=True):
        azimuth = np.arctan2(unit[..., 1], unit[..., 0])
        zenith = np.arccos(unit[..., 2])
        store(folder, f"{name}_az", np.degrees(azimuth), link)
        store(folder, f"{name}_el", np.degrees(zenith), link)
    store(folder, "delay", length / SPEED_OF_LIGHT, link)
    store(folder, "power", -70.0 - 20.0 * np.log10(length), link)
    store(folder, "inter", np.tile([0.0] + [1.0] * len(walls), (N, 1)), link)
    store(folder, "inter_pos", bounce[:, :, None], link)
    store(folder, "rx_pos", receivers, link)
    store(folder, "tx_pos", gnb[None], link)
    rows = ["t,x,y,z,vx,vy,vz"]
    rows += [f"{i},{x:.9f},{y:.9f},{z:.9f},1,0,0" for i, (x, y, z) in enumerate(receivers)]
    (folder / TRUTH).write_text("\n".join(rows))
