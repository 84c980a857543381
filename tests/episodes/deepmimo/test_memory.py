"""Of a grid of users as large as DeepMIMO's O1, some are chosen: the whole is never in memory."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.episodes.deepmimo.scenarios import KEYS, LINK, set_counts, write_hall

# How much is allocated by Python and numpy, and how much more memory than before the process had.
MEASURE = """
import json, re, sys, tracemalloc
from pathlib import Path
import numpy as np
from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.deepmimo.formats import open_scenario

small, large, users = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
read_deepmimo(small, dt_s=1.0)  # imports
status = Path("/proc/self/status")
memory = lambda name: 1024 * int(re.search(name + r":\\s+(\\d+)", status.read_text())[1])
before = memory("VmRSS")
tracemalloc.start()
{work}
traced = tracemalloc.get_traced_memory()[1]
print(json.dumps([traced, memory("VmHWM") - before, recording.visible.sum(axis=0).tolist()]))
"""

CHOOSE = """
grid = open_scenario(Path(large)).grid()
recording = read_deepmimo(large, users=users, dt_s=1.0)
assert np.array_equal(grid[users], recording.position_m)
"""
WALK = """
from mmwave_env.episodes.deepmimo.along import record_along
from mmwave_env.episodes.trajectory import Trajectory
grid = open_scenario(Path(large)).grid()
way = Trajectory("walk", np.arange(len(users)), grid[users])
recording, count, error_m = record_along(large, way, 1.0)
assert count == len(users) and error_m.max() == 0.0
"""

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")


def write_grid(folder, chosen, receivers, paths, suffix):
    """A grid of receivers every 0.2 m, whose chosen ones alone have paths that mean something."""
    along = np.arange(receivers)
    position = np.column_stack([0.2 * (along % 2000), 0.2 * (along // 2000), np.full(receivers, 2)])
    position = position.astype(np.float32)
    hall = folder.with_name("hall")
    hall.mkdir()
    wall = (np.array([0.0, -1.0, 0.0]), 20.0)
    write_hall(hall, np.array([30.0, -10.0, 6.0]), position[chosen].astype(float), [wall])
    folder.mkdir()
    shutil.copy(hall / "params.json", folder)
    set_counts(folder, receivers)
    for key in KEYS:
        with np.load(hall / f"{key}_{LINK}.npz") as archive:
            part = archive[key].astype(np.float32)
        file = folder / f"{key}_{LINK}.npy"
        rest = part.shape[1:] if key[1:] == "x_pos" else (paths, *part.shape[2:])
        rows = 1 if key == "tx_pos" else receivers
        # A file with holes: zeros that nobody has written.
        array = np.lib.format.open_memmap(file, "w+", np.float32, (rows, *rest))
        if key == "tx_pos":
            array[:] = part
        elif key == "rx_pos":
            array[:] = position
        else:
            array[chosen] = np.nan
            array[chosen, : part.shape[1]] = part
        del array
        if suffix == ".npz":
            target = file.with_suffix(".npz")
            with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                archive.write(file, f"{key}.npy")
            file.unlink()
    return hall


def peaks(tmp_path, receivers, paths, suffix, work=CHOOSE):
    users = [receivers // 2 + 5 * n for n in range(200)]
    hall = write_grid(tmp_path / "grid", users, receivers, paths, suffix)
    script = MEASURE.replace("{work}", work)
    command = [sys.executable, "-c", script, hall, tmp_path / "grid", json.dumps(users)]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    traced, resident, seen = json.loads(done.stdout)
    assert seen == [200, 200, 200]
    return traced, resident


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_of_a_grid_only_the_positions_and_the_users_chosen_are_in_memory(tmp_path, suffix):
    whole = 20_000 * 25 * 4  # bytes of one key of ten, and there is one six times as large
    traced, _ = peaks(tmp_path, 20_000, 25, suffix)
    assert traced < 2.5 * whole


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_a_grid_as_large_as_o1_takes_64_mib(tmp_path, suffix):
    traced, resident = peaks(tmp_path, 1_200_000, 25, suffix)  # 1.5 GB
    assert max(traced, resident) < 64 * 2**20, (traced, resident)


@pytest.mark.slow
def test_a_walk_through_a_grid_as_large_as_o1_takes_192_mib(tmp_path):
    """Beside what its users take, where all of them stand, sorted for the search."""
    traced, resident = peaks(tmp_path, 1_200_000, 25, ".npy", WALK)
    assert max(traced, resident) < 192 * 2**20, (traced, resident)
