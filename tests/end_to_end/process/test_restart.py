"""A server that is restarted tells of its map what it told before, and so does its checkpoint."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from support import servers
from triquad_client import ServerStatus
from triquad_format.wire.status_messages import FieldFit
from triquad_tools.commands.inspect import main

SCANS = 5
FIGURES = ("rays", "median_m", "upper_m")


def fit_of(status: ServerStatus) -> FieldFit:
    assert status.fit is not None
    return status.fit


def assert_same_fit(have: FieldFit, want: FieldFit, within_m: float) -> None:
    assert have.rays == want.rays > 100
    assert have.median_m == pytest.approx(want.median_m, abs=within_m)
    assert have.upper_m == pytest.approx(want.upper_m, abs=3 * within_m)
    assert len(have.worst) > 0


def test_what_is_told_of_the_map_goes_on_and_of_the_process_begins_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with servers.service_and_client(store=tmp_path / "store") as client:
        with_holes = servers.sphere()
        with_holes[:10] = np.nan
        client.publish_scan(with_holes, np.eye(4))
        before = servers.learn_all(client, SCANS - 1)
    assert main([str(tmp_path / "store" / servers.MAP), "--json"]) == 0
    file = json.loads(capsys.readouterr().out)
    with servers.service_and_client(store=tmp_path / "store") as client:
        after, metrics = client.status(), client.metrics()
        later, later_metrics = servers.learn_all(client, 1), client.metrics()
    names = ("scans_taken", "samples_trained", "samples_left", "regions", "parameters", "rays_kept")
    for name in names:
        assert getattr(after, name) == getattr(before, name), name
    assert after.scans_taken == SCANS
    assert after.loss == pytest.approx(before.loss, rel=1e-6)
    assert later.scans_taken == SCANS + 1
    assert before.points_dropped
    assert not after.points_dropped
    assert metrics.samples_trained == 0
    trained = later.samples_trained - after.samples_trained
    assert later_metrics.samples_trained == trained > 0
    assert after.fit is None, "no region is in memory"
    # The file is judged by rays that are rounded, of a field that is.
    told = file["fit"]
    of_file = dataclasses.replace(fit_of(before), **{name: told[name] for name in FIGURES})
    assert_same_fit(of_file, fit_of(before), within_m=2e-3)
    assert file["progress"]["scans_taken"] == after.scans_taken
    assert file["progress"]["samples_trained"] == after.samples_trained
