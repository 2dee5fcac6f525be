"""The scans of a server as one bag, which anything that reads bags can map again."""

from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from support.maps.drifted import SCANS, SETTINGS, off
from support.maps.small_world import world
from triquad_tools.commands.pack import main
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions


def test_scans_are_exported_with_corrected_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, bag = tmp_path / "store", tmp_path / "scans.mcap"
    scans = world(SCANS).scans
    true = np.array([scan.world_from_sensor for scan in scans])
    with (
        servers.running_service(SETTINGS, store=store) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        for number, scan in enumerate(scans):
            pose = scan.world_from_sensor @ off()
            client.publish_scan(scan.points, pose, source="lidar", stamp_s=float(number))
        client.flush()
        client.correct_poses("lidar", np.arange(SCANS, dtype=float), true)
    assert main([str(store), str(bag)]) == 0
    assert f"{SCANS} scans of 1 sources" in capsys.readouterr().out
    recording = open_recording(bag, ReadingOptions())
    read = list(recording.read(range(len(recording.entries))))
    np.testing.assert_allclose([scan.world_from_sensor for scan in read], true, atol=1e-3)
    for found, scan in zip(read, scans, strict=True):
        assert 0 < len(found.points) <= len(scan.points)
        at = found.points @ found.world_from_sensor[:3, :3].T + found.world_from_sensor[:3, 3]
        assert np.median(np.abs(world(SCANS).scene.sdf(at.astype(np.float64)))) < 0.02
    assert main([str(store), str(bag)]) == 2
    assert "--force" in capsys.readouterr().err
    min(store.rglob("scans-*.mcap")).unlink()  # as a server does that has no room for more
    assert main([str(store), str(bag), "--force"]) == 0
    assert "are not kept any more: see store.log_max_bytes" in capsys.readouterr().out


def test_what_has_no_scans_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), str(tmp_path / "scans.mcap")]) == 2
    assert "store.log_max_bytes" in capsys.readouterr().err
    assert main([str(tmp_path), str(tmp_path / "scans.mcap"), "--at", "5"]) == 2
    assert "are of maps" in capsys.readouterr().err
    assert not (tmp_path / "scans.mcap").exists()
