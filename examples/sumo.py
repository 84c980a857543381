"""SUMO: convert floating-car data to ways (trajectories); every episode draws one of them.

python examples/sumo.py traffic.xml.gz ways.csv --scene street
mmwave-loc compare --policies fixed-ekf imm --scenario ways.csv --episode-steps 60

The first argument is the XML file of `sumo --fcd-output`, which may be gzipped. With --make the
program makes this file first: vehicles and pedestrians move at random through a grid of streets
with traffic lights (this needs pip install --group sumo).
"""

import argparse
import csv
import gzip
import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np

from mmwave_env.models.scene import scene_from
from mmwave_env.world.trajectory import Trajectory


def read_trips(path):
    """Read a table (N, 3) of t, x, y for every vehicle and person, by id."""
    trips = {}
    with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
        for _, step in ElementTree.iterparse(file):
            if step.tag == "timestep":
                for user in step:
                    row = (step.get("time"), user.get("x"), user.get("y"))
                    trips.setdefault(user.get("id"), []).append(tuple(map(float, row)))
                step.clear()
    return {name: np.array(rows) for name, rows in trips.items()}


def ways_in(scene, trips, least_s, shift_m=None):
    """Return all trips that are long enough and not behind walls; print why others are left out.

    If ``shift_m`` is None, the middle of the traffic is moved to the middle of the streets.
    """
    places = np.concatenate([rows[:, 1:] for rows in trips.values()])
    if shift_m is None:
        streets = np.mean([scene.streets.x_m, scene.streets.y_m], axis=1)
        shift_m = np.round(streets - 0.5 * (places.min(axis=0) + places.max(axis=0)), 2)
    print(f"{len(trips)} trips, moved by {tuple(map(float, shift_m))} m")
    ways = []
    short = 0
    for name, rows in trips.items():
        place = np.pad(
            rows[:, 1:] + shift_m, [(0, 0), (0, 1)], constant_values=scene.streets.height_m
        )
        if np.ptp(rows[:, 0]) < least_s:
            short += 1
            continue
        try:
            way = Trajectory(name, rows[:, 0], place)
            way.way(scene, 1.0)  # refuses ways behind a wall
        except ValueError as error:
            print(f"left out: {error}")
        else:
            ways.append(way)
    print(f"{short} trips left out, because they are shorter than {least_s:g} s")
    return ways


def write_ways(path, ways):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "id", "x", "y", "z"])
        for way in ways:
            for t, place in zip(way.time_s, way.position_m, strict=True):
                writer.writerow([float(t), way.name, *(f"{value:.2f}" for value in place)])
    print(f"{len(ways)} ways written to {path}")


def make_traffic(out, seconds, seed, blocks=2, block_m=80):
    """Write the traffic file ``out`` with SUMO's netgenerate, randomTrips.py and sumo."""
    home = Path(distribution("eclipse-sumo").locate_file("sumo"))

    def run(program, options, *values):
        tool = program.endswith(".py")
        file = home / ("tools" if tool else "bin") / program
        words = [sys.executable] * tool + [file, *options.split(), *values]
        known = os.environ | {"SUMO_HOME": str(home)}
        quiet = {"stdout": subprocess.DEVNULL}
        subprocess.run([*map(str, words)], cwd=folder, env=known, check=True, **quiet)

    with TemporaryDirectory() as folder:
        lights = "--default-junction-type traffic_light --sidewalks.guess --crossings.guess"
        size = f"--grid --grid.number {blocks + 1} --grid.length {block_m}"
        run("netgenerate", f"{size} {lights} --no-turnarounds -o net.xml")
        for kind, more in (("vehicle", ""), ("pedestrian", "--pedestrians")):
            trips = f"-n net.xml -o {kind}.trips.xml -r {kind}.xml -e {seconds} -p 8 --seed {seed}"
            least = f"--min-distance {0.5 * blocks * block_m}"
            run("randomTrips.py", f"{trips} --prefix {kind} {least} {more}")
        routes = f"-n net.xml -r vehicle.xml,pedestrian.xml -e {seconds} --seed {seed}"
        steps = "--no-step-log --step-length 1 --lanechange.duration 3"
        run("sumo", f"{routes} {steps} --fcd-output", out.resolve())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("traffic", type=Path, help="file of floating-car data, .xml or .xml.gz")
    parser.add_argument("ways", type=Path, help="CSV file to write")
    parser.add_argument("--scene", default="street", help="scene into which traffic is moved")
    parser.add_argument("--least", type=float, default=60.0, help="minimum duration of trips, s")
    shift = "shift of all positions in x and y, m; by default to the middle of the streets"
    parser.add_argument("--shift", type=float, nargs=2, help=shift)
    make = "first make traffic that lasts this long, and write it to the file of floating-car data"
    parser.add_argument("--make", type=int, metavar="SECONDS", help=make)
    parser.add_argument("--seed", type=int, default=0, help="seed of the traffic to make")
    args = parser.parse_args()
    if args.make:
        make_traffic(args.traffic, args.make, args.seed)
    trips = read_trips(args.traffic)
    write_ways(args.ways, ways_in(scene_from(args.scene), trips, args.least, args.shift))
