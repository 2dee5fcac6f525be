"""Save a costmap of a place, inflated by a robot's size, as a PGM and a YAML of map_server."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import triquad_client
from numpy.typing import NDArray
from triquad_client import Grid, Status

LETHAL, INSCRIBED, UNKNOWN = 100, 99, -1  # of nav_msgs/OccupancyGrid
MAX_DISTANCE_M = 2.0  # what is farther costs nothing


@dataclass(frozen=True)
class Robot:
    """A column of balls, the lowest of which clears the floor by the step."""

    radius_m: float
    height_m: float
    step_m: float  # it drives over what is lower

    def layers(self, floor_m: float) -> tuple[float, float]:
        """The heights of the lowest and the highest ball's centre."""
        lowest = floor_m + self.step_m + self.radius_m
        return lowest, max(lowest, floor_m + self.height_m - self.radius_m)


def costs(grid: Grid, robot: Robot, floor_m: float, decay: float) -> NDArray[np.int8]:
    """Costs [x, y] of the robot's balls at the grid's layers."""
    heights = grid.shape.corner[2] + (np.arange(grid.shape.counts[2]) + 0.5) * grid.shape.cell_m
    # The floor is near, too, and no obstacle: what counts is nearer than it by the step.
    counts = grid.distance_m <= heights - floor_m - robot.step_m
    distance = np.where(counts, grid.distance_m, np.inf).min(axis=2)
    beyond = np.maximum(distance - robot.radius_m, 0.0)
    cost = ((INSCRIBED - 1) * np.exp(-decay * beyond)).astype(np.int8)
    # Where no ray has been there may be anything: distances are to what was seen.
    cost[(grid.status == Status.UNKNOWN).any(axis=2)] = UNKNOWN
    cost[distance <= robot.radius_m] = INSCRIBED
    cost[distance <= grid.shape.cell_m / 2] = LETHAL
    return cost


def save(cost: NDArray[np.int8], corner: NDArray[np.float64], cell: float, out: Path) -> None:
    """Write ``out``.pgm and ``out``.yaml, whose raw mode keeps every cost; 255 is unknown."""
    pixels = np.where(cost == UNKNOWN, 255, cost).astype(np.uint8).T[::-1]  # largest y on top
    rows, columns = pixels.shape
    out.with_suffix(".pgm").write_bytes(b"P5\n%d %d\n255\n" % (columns, rows) + pixels.tobytes())
    out.with_suffix(".yaml").write_text(
        f"image: {out.with_suffix('.pgm').name}\n"
        "mode: raw\n"
        f"resolution: {cell}\n"
        f"origin: [{corner[0]:.6f}, {corner[1]:.6f}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )


def main() -> None:
    """Of the demo's road, for a robot that stands on z = 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("out", type=Path, help="name of the files, without .pgm and .yaml")
    add("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    add("--map", default="demo")
    add("--low", type=float, nargs=2, default=(0.0, -8.0), metavar="M", help="least x and y")
    add("--high", type=float, nargs=2, default=(28.0, 8.0), metavar="M", help="largest x and y")
    add("--floor", type=float, default=0.0, help="z on which the robot stands, metres")
    add("--step", type=float, default=0.1, help="what it drives over, metres")
    add("--height", type=float, default=1.4, help="of the robot, metres")
    add("--radius", type=float, default=0.35, help="of the robot, metres")
    add("--decay", type=float, default=3.0, help="of costs beyond the radius, per metre")
    add("--cell", type=float, default=0.1, help="metres")
    options = parser.parse_args()
    robot = Robot(options.radius, options.height, options.step)
    lowest, highest = robot.layers(options.floor)
    half = options.cell / 2  # the grid answers at the middles of its cells
    bounds = ((*options.low, lowest - half), (*options.high, highest + half))
    with triquad_client.connect(options.connect, options.map) as client:
        grid = client.query_grid(bounds, options.cell, MAX_DISTANCE_M)
    cost = costs(grid, robot, options.floor, options.decay)
    save(cost, grid.shape.corner, options.cell, options.out)
    print(f"{cost.shape[0]} x {cost.shape[1]} cells of {options.cell} m, epoch {grid.epoch}")
    for name, share in {
        "unknown": cost == UNKNOWN,
        "collision": cost >= INSCRIBED,
        "free": (cost >= 0) & (cost < INSCRIBED),
    }.items():
        print(f"{name:10}{share.mean():7.1%}")


if __name__ == "__main__":
    main()
