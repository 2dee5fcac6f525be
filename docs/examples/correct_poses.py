"""Publish a drive whose poses drift, then correct them as a SLAM does that has closed a loop."""

import argparse
import time

import numpy as np
import triquad_client
from numpy.typing import NDArray

HALL_M = np.array([30.0, 12.0, 5.0])  # one corner lies at 0 0 0
SCANS, KEYFRAME_EVERY = 21, 5
DRIFT_M, DRIFT_DEG = -0.02, 0.3  # along y and in yaw, from scan to scan
PLACE = np.array([20.0, 10.0, 2.5])  # 2 m from the wall at y = 12, and 2.5 m from the floor


def true_pose(number: int) -> NDArray[np.float64]:
    """The pose ``world_from_sensor`` [4, 4] of a scan: a metre farther along the hall each time."""
    pose = np.eye(4)
    pose[:3, 3] = 5.0 + number, 6.0, 1.5
    return pose


def drifted_pose(number: int) -> NDArray[np.float64]:
    """The pose that odometry tells."""
    yaw, pose = np.radians(DRIFT_DEG * number), true_pose(number)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[1, 3] += DRIFT_M * number
    return pose


def scan(number: int) -> NDArray[np.float64]:
    """Points [N, 3], sensor frame, of 32 x 360 rays that meet the walls of the hall."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(360) + 0.5), np.radians(np.linspace(-25, 15, 32))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    at, rays = true_pose(number)[:3, 3], rays.reshape(-1, 3)
    ranges = (np.where(rays > 0, HALL_M, 0.0) - at) / rays
    points: NDArray[np.float64] = ranges.min(axis=1, keepdims=True) * rays
    return points


def tell(client: triquad_client.Client, when: str) -> None:
    """Print how far the wall is from a place, once all is learnt."""
    epoch = client.settle().epoch
    distance_m = client.query_distance(PLACE[None], at_epoch=epoch).distance_m[0]
    print(f"{when}: the wall is {distance_m:.2f} m away, of 2.00")


def main() -> None:
    """Map with poses that drift, and correct those of every fifth scan."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447")
    endpoint = parser.parse_args().connect
    stamps_s = time.time() + 0.1 * np.arange(SCANS)  # kept: the correction names scans by them
    with triquad_client.connect(endpoint) as client:
        for number, stamp_s in enumerate(stamps_s):
            client.publish_scan(scan(number), drifted_pose(number), stamp_s, source="roof")
        tell(client, "as published")
        keyframes = range(0, SCANS, KEYFRAME_EVERY)
        reply = client.correct_poses(
            "roof", stamps_s[keyframes], [true_pose(number) for number in keyframes], onward=True
        )
        print(f"{reply.scans_moved} scans moved, {reply.scans_learnt} learnt again; {reply.undo}")
        tell(client, "corrected")


if __name__ == "__main__":
    main()
