"""A server that is restarted tells of its map what it told before, and so does its checkpoint."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from support import servers
from triquad_client import ServerMetrics, ServerStatus
from triquad_format.wire.messages import FieldFit
from triquad_tools.commands.inspect import main

SCANS = 5


class Restart(NamedTuple):
    """A server that was stopped, and started again."""

    store: Path
    before: ServerStatus
    after: ServerStatus
    metrics: ServerMetrics  # just after
    later: ServerStatus  # after one more scan
    later_metrics: ServerMetrics


@pytest.fixture(scope="module")
def restart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Restart]:
    store = tmp_path_factory.mktemp("store")
    with servers.service_and_client(store=store) as client:
        with_holes = servers.sphere()
        with_holes[:10] = np.nan
        client.publish_scan(with_holes, np.eye(4))
        servers.learn(client, SCANS - 1)
        before = client.settle(servers.WAIT_S)
    checkpoint = store.with_name("copy")
    shutil.copytree(store / servers.MAP, checkpoint)
    with servers.service_and_client(store=store) as client:
        after, metrics = client.status(), client.metrics()
        servers.learn(client, 1)
        yield Restart(
            checkpoint,
            before,
            after,
            metrics,
            client.settle(servers.WAIT_S),
            client.metrics(),
        )


def fit_of(status: ServerStatus) -> FieldFit:
    assert status.fit is not None
    return status.fit


def inspected(folder: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    assert main([str(folder), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_what_is_told_of_the_map_goes_on(restart: Restart) -> None:
    before, after = restart.before, restart.after
    for name in ("scans_taken", "samples_trained", "samples_left", "regions", "parameters"):
        assert getattr(after, name) == getattr(before, name), name
    assert after.scans_taken == SCANS
    assert after.loss == pytest.approx(before.loss, rel=1e-6)
    assert after.loss > 0
    assert after.rays_kept == before.rays_kept
    assert restart.later.scans_taken == before.scans_taken + 1
    assert restart.later.samples_trained > before.samples_trained


def test_what_is_told_of_the_process_begins_anew(restart: Restart) -> None:
    assert restart.before.points_dropped
    assert not restart.after.points_dropped
    assert restart.metrics.samples_trained == 0
    trained = restart.later.samples_trained - restart.after.samples_trained
    assert restart.later_metrics.samples_trained == trained > 0


def test_the_map_is_judged_at_once(restart: Restart) -> None:
    """By rays that are rounded, of a field that is."""
    before, after = fit_of(restart.before), fit_of(restart.after)
    assert after.rays == before.rays > 100
    assert after.median_m == pytest.approx(before.median_m, abs=1e-3)
    assert after.upper_m == pytest.approx(before.upper_m, abs=3e-3)
    assert len(after.worst) > 0


def test_the_file_tells_what_the_server_tells(
    restart: Restart, capsys: pytest.CaptureFixture[str]
) -> None:
    told, status = inspected(restart.store, capsys), restart.after
    assert told["progress"]["scans_taken"] == status.scans_taken
    assert told["progress"]["samples_trained"] == status.samples_trained
    have, want = told["fit"], fit_of(status)
    assert have["rays"] == want.rays
    assert have["median_m"] == pytest.approx(want.median_m, abs=1e-5)
    assert have["upper_m"] == pytest.approx(want.upper_m, abs=1e-5)
    assert have["worst_median_m"] == pytest.approx(want.worst_median_m, abs=1e-5)
    assert np.allclose(have["worst"], want.worst)
