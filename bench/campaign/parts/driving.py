"""Hours of driving a lap, as fast as the server takes the scans: memory stays flat."""

import numpy as np
import triquad_client
from support import servers
from triquad_tools.simulation.lidar import Lidar, SimulatedScan, drive
from triquad_tools.simulation.street import street

from bench.campaign.server_under_test import expect, expect_honest_service, server_under_test
from bench.campaign.turn import Turn

_SCANS_PER_S = 10
_LAP_SCANS = 40
_LAP_M = 20.0
_PENDING = 8
_WARM_SHARE = 0.5  # of the drive, after which memory is compared with what it was then
_MAX_GROWTH_BYTES = 30 * 2**20


def run(turn: Turn) -> None:
    """Drive up and down a street, and measure memory every simulated minute."""
    lap = _lap(turn.seed)
    with server_under_test(turn) as server, triquad_client.connect(server.endpoint) as client:
        taken: list[int] = []
        number = 0
        while not turn.over:
            for _ in range(_SCANS_PER_S):
                scan = lap[number % len(lap)]
                number += 1
                client.publish_scan(
                    scan.points, scan.world_from_sensor, stamp_s=1e9 + number / _SCANS_PER_S
                )
            report = client.flush(servers.WAIT_S, pending=_PENDING)
            turn.did("seconds")
            taken.append(server.resident_bytes)
        report = client.flush(servers.WAIT_S)
        expect(report.lost == report.refused == 0, f"scans are missing: {report}")
        warm = taken[int(_WARM_SHARE * len(taken)) :]
        growth = float(np.mean(warm[-10:]) - np.mean(warm[:10]))
        turn.measured("growth MB", growth / 2**20)
        turn.measured("memory MB", max(taken) / 2**20)
        expect(growth < _MAX_GROWTH_BYTES, f"memory grew by {growth:.0f} bytes on the same lap")
        expect_honest_service(server.endpoint)


def _lap(seed: int) -> list[SimulatedScan]:
    """Return scans up a street and back."""
    scene = street(seed)
    rng = np.random.default_rng(seed)
    lidar = Lidar(beams=16, columns=120, range_max_m=25.0)
    poses = drive(scene, _LAP_SCANS, _LAP_M / _LAP_SCANS)
    there = [lidar.scan(scene, pose, rng) for pose in poses]
    return there + there[::-1]
