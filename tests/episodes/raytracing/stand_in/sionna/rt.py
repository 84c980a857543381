"""A ray tracer of two walls with Sionna RT's calls and arrays; it fails as Sionna RT does.

``STAND_IN`` says how: ``missing`` as without LLVM, ``abort`` as with an unfit one, ``fail`` as with
a fault of its own.
"""

import os
import sys
from types import SimpleNamespace

import numpy as np

HOW = os.environ.get("STAND_IN", "")
WALLS_M = (9.571564, -8.613335)  # y, of simple_street_canyon

if HOW == "missing":
    print('jit_find_library(): Unable to load "libLLVM.so": no such file!', file=sys.stderr)
    raise ImportError("the LLVM backend is inactive because LLVM could not be found!")

scene = SimpleNamespace(simple_street_canyon="canyon.xml", box="box.xml")


def load_scene(file, merge_shapes):
    if file != scene.simple_street_canyon:
        raise RuntimeError(f"no such file: {file}")
    print("a library says something, too")
    return Scene()


class Scene:
    frequency = 3.5e9

    def __init__(self):
        self.devices = {}

    def __setattr__(self, name, value):
        super().__setattr__(name, np.array([value]) if name == "frequency" else value)

    def add(self, device):
        self.devices[device.name] = device

    def remove(self, name):
        del self.devices[name]


def PlanarArray(**what):
    return SimpleNamespace(**what)


def Transmitter(name, position):
    return SimpleNamespace(name=name, position=position, sends=True)


def Receiver(name, position):
    return SimpleNamespace(name=name, position=position, sends=False)


def PathSolver():
    return solve


def solve(scene, max_depth, synthetic_array, **others):
    if HOW == "abort":
        print("LLVM ERROR: Cannot select: fmaximum", file=sys.stderr, flush=True)
        os.abort()
    if HOW == "fail":
        raise MemoryError("too many rays")
    assert synthetic_array and max_depth == 1
    ends = [
        np.array([d.position for d in scene.devices.values() if d.sends == sends], float)
        for sends in (True, False)
    ]
    return canyon_paths(*ends)


def canyon_paths(transmitters, receivers):
    """What ``sionna.rt.Paths`` holds, of transmitters (T, 3) and receivers (R, 3).

    The weaker reflection comes first and the line of sight last, for the order means nothing; no
    receiver west of x = -40 m sees the southern wall, and none north of y = 100 m anything.
    """
    g, p = transmitters[None], receivers[:, None]
    images = np.stack([np.broadcast_to(g, (len(receivers), *transmitters.shape))] * 3, axis=-2)
    for i, y in enumerate(WALLS_M):
        images[..., i, 1] = 2.0 * y - images[..., i, 1]
    away = images - p[..., None, :]
    share = np.stack([(y - p[..., 1]) / away[..., i, 1] for i, y in enumerate(WALLS_M)], axis=-1)
    bounce = np.zeros(away.shape)
    bounce[..., :2, :] = p[..., None, :] + share[..., None] * away[..., :2, :]
    leaving = np.where(np.arange(3)[:, None] < 2, bounce, p[..., None, :]) - g[..., None, :]
    valid = np.broadcast_to(p[..., None, 1] < 100.0, away.shape[:3]).copy()
    valid[..., 1] = p[..., 0] > -40.0
    length = np.linalg.norm(away, axis=-1)
    gain = (np.array([-0.2, -0.1, 1.0]) / (1e3 * length))[:, None, :, None]
    return SimpleNamespace(
        sources=transmitters.T, targets=receivers.T, valid=valid,
        tau=np.where(valid, length / 299_792_458.0, -1.0).astype(np.float32),
        a=(gain.astype(np.float32), np.zeros_like(gain, np.float32)),
        phi_r=np.arctan2(away[..., 1], away[..., 0]), theta_r=_zenith(away),
        phi_t=np.arctan2(leaving[..., 1], leaving[..., 0]), theta_t=_zenith(leaving),
        interactions=np.where(valid, [1, 1, 0], 0)[None].astype(np.uint32),
        vertices=bounce[None].astype(np.float32),
    )  # fmt: skip


def _zenith(way):
    return np.arctan2(np.hypot(way[..., 0], way[..., 1]), way[..., 2])
