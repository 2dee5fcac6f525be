"""What goes wrong with scans reaches the server's log and who publishes them."""

import logging

import numpy as np
import pytest
from support import servers
from triquad_client import FlushReport

POSE = np.eye(4)


def half_near() -> np.ndarray:
    return np.concatenate([servers.sphere(500, 1.0), servers.sphere(500, 6.0)])


def test_a_publisher_learns_what_a_setting_takes_of_its_scans_and_is_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with servers.service_and_client() as client, caplog.at_level(logging.WARNING):
        reports: list[FlushReport] = []
        for _ in range(2):
            for _ in range(12):
                client.publish_scan(half_near(), POSE, source="cam")
            reports.append(client.flush(servers.WAIT_S))
        status = client.status()
    (text,) = reports[0].warnings
    assert text.startswith("source 'cam': range_min_m = 1.5 drops 50 % of its points: set ")
    assert reports[1].warnings == (text,)
    assert status.warnings == text
    assert status.scans_taken == 24
    for logger in ("triquad_client", "triquad_server.intake.scan_warnings"):
        assert [r.getMessage() for r in caplog.records if r.name == logger] == [text]
