"""Find where a scan was taken: align it with the map, and say whether to believe the answer."""

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import triquad_client
from numpy.typing import NDArray
from triquad_client import Alignment, MapQueries, Status

SIMULATED_AT = (12.0, -1.6, 1.8, 0.0)  # x, y, z, yaw in degrees
LEAST_INLIERS = 0.6
MOST_SIGMA_M, MOST_SIGMA_DEG = 0.05, 0.5  # what a controller would still steer by


def pose(x: float, y: float, z: float, yaw_deg: float) -> NDArray[np.float64]:
    """The pose ``world_from_sensor`` [4, 4] of an upright sensor."""
    yaw = np.radians(yaw_deg)
    world_from_sensor = np.eye(4)
    world_from_sensor[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    world_from_sensor[:3, 3] = x, y, z
    return world_from_sensor


def simulated_scan(view: MapQueries, world_from_sensor: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a lidar of 32 x 180 rays would measure there, sensor frame, with 2 cm of noise."""
    azimuth, elevation = np.meshgrid(
        np.arange(180) * np.radians(2.0), np.radians(np.linspace(-25, 15, 32))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    rays = rays.reshape(-1, 3)
    answer = view.query_rays(world_from_sensor[:3, 3], rays @ world_from_sensor[:3, :3].T, 40.0)
    hit = answer.status == Status.SURFACE  # where it is UNKNOWN, nobody knows what is there
    noise = np.random.default_rng(0).normal(0, 0.02, hit.sum())
    return (answer.range_m[hit] + noise)[:, None] * rays[hit]


def read_scan(path: Path) -> NDArray[np.float64]:
    """Points [N, 3] of a ``.npy`` of such points, or of a ``.bin`` of x, y, z, intensity."""
    if path.suffix == ".npy":
        return np.asarray(np.load(path), np.float64)
    return np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)


def doubts(answer: Alignment) -> list[str]:
    """Why not to believe an alignment; empty: believe it."""
    sigma = np.sqrt(np.diag(answer.covariance))
    found = []
    if not answer.converged:
        found.append("it did not converge")
    if answer.inlier_share < LEAST_INLIERS:
        found.append(f"only {answer.inlier_share:.0%} of the points lie on the map")
    if sigma[:3].max() > MOST_SIGMA_M or np.degrees(sigma[3:]).max() > MOST_SIGMA_DEG:
        found.append("a direction is open, as along a bare corridor")
    return found


def open_view(options: argparse.Namespace) -> AbstractContextManager[MapQueries]:
    """The map: from a file, or from a server."""
    if options.file:
        return triquad_client.open_map(options.file)
    return triquad_client.connect(options.connect, options.map)


def main() -> None:
    """In the demo's street, from a guess that is off by a metre and five degrees."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--map", default="demo")
    parser.add_argument("--file", type=Path, help="a map file, instead of a server")
    parser.add_argument("--scan", type=Path, help=".npy or .bin; without it, one is simulated")
    parser.add_argument(
        "--guess",
        type=float,
        nargs=4,
        default=(12.8, -2.1, 1.9, 5.0),
        metavar=("X", "Y", "Z", "YAW_DEG"),
        help="where the sensor is thought to be, map frame",
    )
    options = parser.parse_args()
    with open_view(options) as view:
        if options.scan:
            points = read_scan(options.scan)
        else:
            points = simulated_scan(view, pose(*SIMULATED_AT))
        answer = view.align(points, pose(*options.guess), max_distance_m=2.0)
    found = answer.world_from_sensor
    x, y, z = found[:3, 3]
    yaw_deg = np.degrees(np.arctan2(found[1, 0], found[0, 0]))
    sigma = np.sqrt(np.diag(answer.covariance))
    print(f"{answer.points} points, {answer.iterations} steps, epoch {answer.epoch}")
    print(f"pose     x {x:.3f} m, y {y:.3f} m, z {z:.3f} m, yaw {yaw_deg:.2f} deg")
    print(f"sigma    {sigma[:3].max() * 100:.2f} cm, {np.degrees(sigma[3:].max()):.3f} deg at most")
    print(f"inliers  {answer.inlier_share:.0%}, rms {answer.rms_m * 100:.1f} cm")
    reasons = doubts(answer)
    print("do not use it: " + "; ".join(reasons) if reasons else "believe it")


if __name__ == "__main__":
    main()
