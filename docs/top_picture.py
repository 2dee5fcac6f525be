"""Draws ``images/top.svg``, a page of ``triquad-top``: ``python docs/top_picture.py``.

A server learns a simulated street for half a minute; of its two sensors one is set up badly.
"""

import threading
import time
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import triquad_server
from rich.console import Console
from triquad_client import Client
from triquad_tools.simulation.lidar import Lidar, SimulatedScan, drive
from triquad_tools.simulation.street import street
from triquad_tools.work.top import Sample, page

PICTURE = Path(__file__).parent / "images" / "top.svg"
_WIDTH = 100  # characters
_SECONDS, _RATE_HZ = 30, 4


def _simulated() -> list[SimulatedScan]:
    scene, rng, lidar = street(3), np.random.default_rng(0), Lidar(columns=360)
    return [lidar.scan(scene, pose, rng) for pose in drive(scene, _SECONDS * _RATE_HZ // 5, 1.0)]


def _publish(client: Client, scans: list[SimulatedScan]) -> None:
    """Scans of a lidar, and now and then those of a camera that sees nearer than the server."""
    rng = np.random.default_rng(1)
    for number in range(_SECONDS * _RATE_HZ):
        scan = scans[number % len(scans)]
        client.publish_scan(scan.points, scan.world_from_sensor, source="roof-lidar")
        if number % 5 == 0:
            near = rng.normal(size=(2000, 3)) * 1.5
            client.publish_scan(near, scan.world_from_sensor, source="camera")
        time.sleep(1.0 / _RATE_HZ)


def _ask(client: Client, over: threading.Event) -> None:
    """What a planner asks."""
    rng = np.random.default_rng(2)
    while not over.wait(0.05):
        client.query_distance(rng.uniform(-10, 10, (1000, 3)), max_distance_m=5.0)
        client.query_ground(rng.uniform(-10, 10, (100, 3)))


def main() -> None:
    """Have a server work, and draw the page of its last second."""
    scans, over = _simulated(), threading.Event()
    with TemporaryDirectory() as store, triquad_server.serve(store=store) as server:
        client = server.client()
        planner = threading.Thread(target=_ask, args=(client, over))
        sensors = threading.Thread(target=_publish, args=(client, scans))
        planner.start()
        sensors.start()
        time.sleep(_SECONDS / 2)
        client.checkpoint()
        time.sleep(_SECONDS / 4)
        before = Sample(client.status(), client.metrics())
        time.sleep(1.0)
        after = before.after(client.status(), client.metrics())
        over.set()
        planner.join()
        sensors.join()
    console = Console(width=_WIDTH, file=StringIO(), record=True)
    console.print(page("map default at tcp/robot:7447", after))
    console.save_svg(str(PICTURE), title="triquad-top --connect robot")


if __name__ == "__main__":
    main()
