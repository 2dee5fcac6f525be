"""Be a lidar that does not know where it is: its clouds over Zenoh, for triquad-ros2."""

import argparse
import json
import time

import numpy as np
import triquad_client
import zenoh
from numpy.typing import NDArray
from triquad_format.scan_log.ros_messages import pack_cloud

HALL_M = np.array([30.0, 12.0, 5.0])
SCANS, STEP_M, PERIOD_S = 30, 0.3, 0.1
WAIT_S = 30.0


def scan(number: int) -> NDArray[np.float32]:
    """Points [N, 3], sensor frame, of 32 x 360 rays that meet the walls of the hall."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(360) + 0.5), np.radians(np.linspace(-25, 15, 32))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    at, rays = np.array([5.0 + STEP_M * number, 6.0, 1.5]), rays.reshape(-1, 3)
    ranges = (np.where(rays > 0, HALL_M, 0.0) - at) / rays
    points: NDArray[np.float32] = (ranges.min(axis=1, keepdims=True) * rays).astype(np.float32)
    return points


def publish(endpoint: str, topic: str) -> None:
    """Publish clouds as ``sensor_msgs/PointCloud2``, as fast as a lidar does."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        publisher = session.declare_publisher(
            topic, congestion_control=zenoh.CongestionControl.BLOCK
        )
        until_s = time.monotonic() + WAIT_S
        while not publisher.matching_status.matching:
            if time.monotonic() > until_s:
                raise SystemExit(f"nobody listens: run triquad-ros2 --odometry {topic}")
            time.sleep(PERIOD_S)
        for number in range(SCANS):
            publisher.put(pack_cloud(time.time_ns(), "lidar", scan(number)))
            time.sleep(PERIOD_S)


def trail(client: triquad_client.Client, topic: str) -> NDArray[np.float64]:
    """The positions [N, 3] at which the map has the scans, once they are all there."""
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        found = client.sources().sources.get(topic)
        if found is not None and len(found.trail) >= SCANS:
            return found.trail
        time.sleep(PERIOD_S)
    raise SystemExit("not all scans came: triquad-ros2 tells why")


def main() -> None:
    """Publish a drive of 8.7 m, and tell how far triquad has found that it went."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447")
    parser.add_argument("--topic", default="points")
    options = parser.parse_args()
    with triquad_client.connect(options.connect) as client:
        publish(options.connect, options.topic)
        went_m = np.linalg.norm(np.ptp(trail(client, options.topic), axis=0))
        print(f"the lidar went {went_m:.2f} m, of {STEP_M * (SCANS - 1):.2f}")
        client.settle()
        wall_m = client.query_distance([[0.0, 0.0, 0.0]]).distance_m[0]
        print(f"the floor is {wall_m:.2f} m below where it began, of 1.50")


if __name__ == "__main__":
    main()
