"""Have a second robot map into the map of a first: find where it began, and correct it alone."""

import argparse
import time

import numpy as np
import triquad_client
from numpy.typing import NDArray

HALL_M = np.array([30.0, 12.0, 5.0])  # one corner lies at 0 0 0
SCANS = 15
LEAST_INLIERS, MOST_APART_M = 0.6, 0.05  # of alignments that are believed
PLACE = np.array([20.0, 10.0, 2.5])  # 2 m from the wall at y = 12, and 2.5 m from the floor


def pose(x: float, y: float, yaw_deg: float, z: float = 0.0) -> NDArray[np.float64]:
    """A pose [4, 4] of something upright."""
    yaw, made = np.radians(yaw_deg), np.eye(4)
    made[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    made[:3, 3] = x, y, z
    return made


def scan(world_from_sensor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [N, 3], sensor frame, of 32 x 360 rays that meet the walls of the hall."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(360) + 0.5), np.radians(np.linspace(-25, 15, 32))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    rays = rays.reshape(-1, 3)
    at, turned = world_from_sensor[:3, 3], rays @ world_from_sensor[:3, :3].T
    ranges = ((np.where(turned > 0, HALL_M, 0.0) - at) / turned).min(axis=1, keepdims=True)
    points: NDArray[np.float64] = ranges * rays
    return points


def find_begin(
    client: triquad_client.Client,
    scans: list[NDArray[np.float64]],
    poses: list[NDArray[np.float64]],
    guess: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return where the frame of a robot's poses is in the map, near a guess [4, 4].

    Each scan is aligned by itself; they have to agree.
    """
    found = []
    for points, begin_from_sensor in zip(scans, poses, strict=True):
        answer = client.align(points, guess @ begin_from_sensor)
        if answer.converged and answer.inlier_share >= LEAST_INLIERS:
            found.append(answer.world_from_sensor @ np.linalg.inv(begin_from_sensor))
    if not found:
        raise SystemExit("no scan fits the map: give a better guess, or drive to a place it knows")
    places = np.array(found)[:, :3, 3]
    middle = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    if np.median(middle) > MOST_APART_M:
        raise SystemExit("the scans do not agree where it began: wait for more of them")
    return found[int(middle.argmin())]


def main() -> None:
    """Map by two robots; the poses of the second one drift, and are corrected."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447")
    endpoint = parser.parse_args().connect
    with triquad_client.connect(endpoint) as client:
        for number in range(SCANS):
            first = pose(5.0 + number, 6.0, 0.0, z=1.5)
            client.publish_scan(scan(first), first, source="first")
        client.settle()

        # The second robot only knows how it has moved since it began, and somebody guesses where.
        began = pose(22.0, 4.0, 120.0, z=1.2)
        moved = [pose(0.3 * number, 0.0, 0.0) for number in range(SCANS)]
        scans = [scan(began @ step) for step in moved]
        guess = pose(22.5, 3.6, 112.0, z=1.2)
        begin = find_begin(client, scans[:5], moved[:5], guess)
        off_m = np.linalg.norm(begin[:3, 3] - began[:3, 3])
        print(f"the second robot began {begin[:3, 3].round(2)}, {100 * off_m:.1f} cm off")

        stamps_s = time.time() + 0.1 * np.arange(SCANS)
        for number, stamp_s in enumerate(stamps_s):
            drifted = begin @ moved[number] @ pose(0.0, 0.05 * number, 0.4 * number)
            client.publish_scan(scans[number], drifted, stamp_s, source="second")
        client.flush()
        reply = client.correct_poses("second", stamps_s, [begin @ step for step in moved])
        print(f"{reply.scans_moved} scans of the second robot moved, none of the first")
        epoch = client.settle().epoch
        distance_m = client.query_distance(PLACE[None], at_epoch=epoch).distance_m[0]
        print(f"the wall is {distance_m:.2f} m away, of 2.00")


if __name__ == "__main__":
    main()
