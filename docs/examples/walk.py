"""How far a robot with legs or wheels can go straight on, by the ground below its way."""

import argparse
from dataclasses import dataclass

import numpy as np
import triquad_client
from numpy.typing import NDArray
from triquad_client import Ground, Status

ASKED_EVERY_M = 0.05
STRIDE = 6  # places: a step that the map rounds off is all within 0.3 m
ABOVE_M = 0.5  # the ground is asked for from here: free space that the sensor has seen
MAX_DROP_M = 1.0
LANES = 3  # left wheels, middle, right wheels

Places = NDArray[np.float64]


@dataclass(frozen=True)
class Robot:
    """What it can stand on."""

    width_m: float
    step_m: float  # up or down


def lanes(start: Places, goal: Places, robot: Robot) -> Places:
    """Places [K, LANES, 2] on the way of the robot's wheels or feet."""
    length = float(np.linalg.norm(goal - start))
    along = (goal - start) / length
    left = np.array([-along[1], along[0]])
    metres = np.arange(0, length, ASKED_EVERY_M)[:, None, None]
    aside = np.linspace(0.5, -0.5, LANES)[None, :, None] * robot.width_m
    return np.asarray(start + metres * along + aside * left)


def first_stop(ground: Ground, robot: Robot) -> tuple[int, str] | None:
    """The first place where the robot cannot go on, and why; ``None`` where it can go all along."""
    height, status = ground.height_m.reshape(-1, LANES), ground.status.reshape(-1, LANES)
    rise = np.zeros(height.shape)
    rise[STRIDE:] = height[STRIDE:] - height[:-STRIDE]
    # Only what was seen to be ground will bear: not a hole, and not what nobody has looked at.
    stops = ((status != Status.SURFACE) | (np.abs(rise) > robot.step_m)).any(axis=1)
    if not stops.any():
        return None
    place = int(stops.argmax())
    if (status[place] == Status.FREE).any():
        return place, "no ground: a hole or an edge"
    if (status[place] == Status.UNKNOWN).any():
        return place, "the ground was not seen"
    worst = rise[place, np.abs(rise[place]).argmax()]
    return place, f"a step of {worst:+.2f} m"


def main() -> None:
    """Across the demo's road, to the pavement and the houses."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    add("--map", default="demo")
    add("--start", type=float, nargs=2, default=(17.0, 2.0), metavar="M")
    add("--goal", type=float, nargs=2, default=(17.0, -9.0), metavar="M")
    add("--floor", type=float, default=0.0, help="z of the ground at the start, metres")
    add("--width", type=float, default=0.5, help="of the robot, metres")
    add("--step", type=float, default=0.1, help="what it climbs and descends, metres")
    options = parser.parse_args()
    if options.start == options.goal:
        parser.error("start and goal are the same place")
    robot = Robot(options.width, options.step)
    places = lanes(np.array(options.start), np.array(options.goal), robot)
    heights = np.full((*places.shape[:2], 1), options.floor + ABOVE_M)
    points = np.concatenate([places, heights], axis=2).reshape(-1, 3)
    with triquad_client.connect(options.connect, options.map) as client:
        ground = client.query_ground(points, MAX_DROP_M)
    print(f"{len(points)} places over {len(places) * ASKED_EVERY_M:.1f} m, epoch {ground.epoch}")
    stop = first_stop(ground, robot)
    if stop is None:
        print("free all along")
    else:
        print(f"stop after {stop[0] * ASKED_EVERY_M:.2f} m: {stop[1]}")


if __name__ == "__main__":
    main()
