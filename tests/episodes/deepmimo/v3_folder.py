"""DeepMIMO v3 folders of our own making: no public one can be shipped."""

import numpy as np
from scipy.io import savemat

TRANSMIT_DBM = 10.0


def cell(station, epoch, doppler):
    """What a file says of a user: a struct with a column for each path."""
    there = np.isfinite(station.interactions[epoch])
    arrival, departure = (
        np.degrees(of[epoch, there]) for of in (station.arrival, station.departure)
    )
    rows = [
        np.degrees(station.phase_rad[epoch, there]) if station.phase_rad is not None
        else np.zeros(there.sum()),
        station.delay_s[epoch, there], station.gain_db[epoch, there] + TRANSMIT_DBM,
        arrival[:, 0], arrival[:, 1], departure[:, 0], departure[:, 1],
        station.interactions[epoch, there] == 0.0,
    ]  # fmt: skip
    rows += [np.full(there.sum(), np.nan)] * 2 * doppler  # not read
    return {"p": np.array(rows, float)}


def cells(entries):
    """A cell array."""
    array = np.empty((1, len(entries)), object)
    array[0] = entries
    return array


def write_params(folder, carrier_hz, users=1):
    """What its own loader wants; ours looks at the first two."""
    folder.mkdir(exist_ok=True)
    params = {"carrier_freq": carrier_hz, "transmit_power": TRANSMIT_DBM, "num_BS": 1,
              "user_grids": np.array([[1, 1, users]]), "doppler_available": 0,
              "dual_polar_available": 0}  # fmt: skip
    savemat(folder / "params.mat", params)


def write_users(scene, paths, first, last, epochs, doppler=False, tx_loc=True):
    """Files of users ``first`` up to ``last``: these epochs of the paths, for each station."""
    scene.mkdir(exist_ok=True)
    for b, station in enumerate(paths.stations, start=1):
        places = paths.position_m[epochs]
        away = np.linalg.norm(places - station.position_m, axis=1)
        content = {
            "channels": cells([cell(station, epoch, doppler) for epoch in epochs]),
            "rx_locs": np.column_stack([places, away, np.full(len(away), 100.0)]),
        }
        if tx_loc:
            content["tx_loc"] = station.position_m[None]
        else:
            others = np.full((b, 5), -1.0)
            others[b - 1, :3] = station.position_m
            savemat(scene / f"BS{b}_BS.mat", {"rx_locs": others})
        savemat(scene / f"BS{b}_UE_{first}-{last}.mat", content, do_compression=True)


def write_static(folder, paths, a_file=50, **options):
    """A static scenario whose users are the receivers of the paths, so many in a file."""
    users = np.arange(len(paths.position_m))
    write_params(folder, paths.carrier_hz, len(users))
    for first in range(0, len(users), a_file):
        chosen = users[first : first + a_file]
        write_users(folder, paths, first, first + len(chosen), chosen, **options)


def write_dynamic(folder, paths, **options):
    """A dynamic scenario: the receivers of the paths are user 1 of its scenes, user 0 stays."""
    write_params(folder, paths.carrier_hz)
    for scene in range(len(paths.position_m)):
        write_users(folder / f"scene_{scene}", paths, 0, 2, [0, scene], **options)
