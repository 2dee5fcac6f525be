"""The steps of the demonstration, each against a running server."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from triquad_client import Client, Mesh
from triquad_format.records.arrays import Doubles

from triquad_tools.console.progress import progress
from triquad_tools.demo.probe import Probe
from triquad_tools.demo.results import DemoResults, Intake
from triquad_tools.plots.picture import draw_mesh
from triquad_tools.recordings.publishing import publish_all, wait_until_settled
from triquad_tools.simulation.lidar import SimulatedDrive, SimulatedScan

MAP = "demo"

_SEED = 0  # of the points that are asked
_SETTLE_LIMIT_S = 70.0
_QUERY_POINTS = 1_000


def demonstrate(client: Client, endpoint: str, drive: SimulatedDrive, out: Path) -> DemoResults:
    """Have a server learn a drive while another process asks it; leave the map in a folder.

    Raises:
        ToolError, TriquadError, OSError: a step failed.
    """
    scans = _simulated(drive)
    with Probe(endpoint, MAP, _asked(scans)) as probe:
        intake = _learnt(client, scans)
        queries = probe.finish()
    with progress("fetching the map and its mesh"):
        client.download_map(out / "map.triquad")
        surface = client.mesh(drive.scene.box)
    _draw(surface, out)
    status = client.status()
    return DemoResults(
        drive.seed,
        intake,
        queries,
        status.fit,
        map_bytes=(out / "map.triquad").stat().st_size,
        parameters=status.parameters,
        faces=len(surface.faces),
    )


def _simulated(drive: SimulatedDrive) -> list[SimulatedScan]:
    scans: list[SimulatedScan] = []
    with progress("simulating the drive", len(drive)) as report:
        for scan in drive:
            scans.append(scan)
            report(len(scans), f"{len(scans)} of {len(drive)} scans")
    return scans


def _asked(scans: Sequence[SimulatedScan]) -> Doubles:
    """Return points [N, 3] of surface along the drive, as a planner asks for."""
    hits = np.concatenate([scan.true_hits for scan in scans])
    return np.random.default_rng(_SEED).choice(hits, _QUERY_POINTS)


def _learnt(client: Client, scans: Sequence[SimulatedScan]) -> Intake:
    """Stream the scans and wait until they are learnt."""
    started = time.monotonic()
    flush = publish_all(client, scans)
    taken_in = time.monotonic()
    status = wait_until_settled(client, _SETTLE_LIMIT_S)
    return Intake(
        scans=len(scans),
        taken=flush.taken,
        refused=flush.refused,
        lost=flush.lost,
        seconds=taken_in - started,
        learning_s=time.monotonic() - started,
        settled=status.settled,
        samples_trained=status.samples_trained,
    )


def _draw(surface: Mesh, out: Path) -> None:
    with progress("drawing") as report:
        for name in ("street.glb", "street.ply"):
            report(0.0, name)
            surface.save(out / name)
        report(0.0, "street.png")
        draw_mesh(f"map {MAP!r}, epoch {surface.epoch}", surface, out / "street.png")
