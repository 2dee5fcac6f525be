"""The steps of the demonstration against a running server, what they measure, and the promises."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client
from triquad_format.wire.status_messages import FieldFit

from triquad_tools.console.amounts import millimetres
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.plots.picture import draw_mesh
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, publish_all, wait_until_settled
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry
from triquad_tools.simulation.lidar import SimulatedDrive, SimulatedScan

MAP = "demo"
_SEED = 0  # of the points that are asked
_SETTLE_LIMIT_S = 70.0
_QUERY_POINTS = 1_000


@dataclass(frozen=True)
class Intake:
    """The figures of integrating and learning scans."""

    scans: int
    taken: int
    refused: int
    lost: int
    seconds: float  # from the first scan until all were integrated
    learning_s: float  # from the first scan until nothing was left to learn, or the limit
    learnt_percent: int  # of what the scans can teach; below 100 the limit came first
    samples_trained: int


@dataclass(frozen=True)
class DemoResults:
    """All measurements of the demonstration."""

    seed: int
    intake: Intake
    queries: ProbeReport
    fit: FieldFit | None  # to rays that were never trained on; None: there are too few
    map_bytes: int  # of the map file
    parameters: int
    faces: int  # of the mesh


def broken_promises(results: DemoResults) -> list[str]:
    """Return a line for each promise that was not kept, with value and limit."""
    intake, queries, fit = results.intake, results.queries, results.fit
    at_most = {
        "error at held-out rays (m)": (math.nan if fit is None else fit.median_m, 0.01),
        "scans lost or refused": (intake.lost + intake.refused, 0),
        "query errors": (queries.errors, 0),
        "answers from an older epoch": (queries.epochs_backwards, 0),
    }
    return [
        f"{name} is {value:.4g}; promised is at most {limit:g}"
        for name, (value, limit) in at_most.items()
        if not value <= limit  # NaN keeps no promise
    ]


def table_rows(results: DemoResults) -> list[Row]:
    """Return the results as lines of a table."""
    intake, queries, fit = results.intake, results.queries, results.fit
    end = "which is all there is to learn"
    if intake.learnt_percent < 100:
        end = f"{intake.learnt_percent} % of what there is to learn: a server would go on"
    taken_per_s = intake.taken / max(intake.seconds, 1e-9)
    samples_m, learning_s = intake.samples_trained / 1e6, intake.learning_s
    trained = f"{samples_m / max(learning_s, 1e-9):.2f} M samples/s"
    asked = f"median of {queries.queries:,} while training; 99 %: {queries.latency_p99_ms:.1f} ms, "
    asked += f"longest {queries.latency_max_ms:.1f} ms, {queries.errors} errors"
    parameters = f"{results.parameters / 1e6:.2f} M parameters"
    rows = [
        Row("scans taken in", f"{taken_per_s:.1f} /s", f"{intake.taken} of {intake.scans}"),
        Row("training", trained, f"{samples_m:.1f} M in {learning_s:.0f} s, {end}"),
        Row(f"query of {queries.points:,} points", f"{queries.latency_p50_ms:.1f} ms", asked),
        Row("map file", f"{results.map_bytes / 1e6:.2f} MB", parameters),
        Row("mesh", f"{results.faces:,}", "faces"),
    ]
    if fit is not None:
        note = f"90 % in {millimetres(fit.upper_m)}, of {fit.rays:,} rays that were never learnt"
        rows.insert(3, Row("error at held-out rays", millimetres(fit.median_m), note))
    return rows


def demonstrate(
    client: Client, endpoint: str, drive: SimulatedDrive, out: Path, period_s: float = 0.0
) -> DemoResults:
    """Have a server learn a drive while another process asks it; leave the map in a folder.

    Scans are sent every ``period_s`` seconds, or as fast as the server takes them.

    Raises:
        ToolError, TriquadError, OSError: a step failed.
    """
    scans: list[SimulatedScan] = []
    with progress("simulating the drive", len(drive)) as report:
        for scan in drive:
            scans.append(scan)
            report(len(scans), f"{len(scans)} of {len(drive)} scans")
    # Of surface along the drive, as a planner asks for.
    hits = np.concatenate([scan.true_hits for scan in scans])
    asked = np.random.default_rng(_SEED).choice(hits, _QUERY_POINTS)
    with Probe(endpoint, MAP, asked) as probe:
        intake = _learnt(client, scans, period_s)
        queries = probe.finish()
    with progress("fetching the map and its mesh"):
        client.download_map(out / "map.triquad")
        surface = client.mesh(drive.scene.box)
    with progress("drawing") as report:
        for name in ("street.glb", "street.ply"):
            report(0.0, name)
            surface.save(out / name)
        report(0.0, "street.png")
        draw_mesh(f"map {MAP!r}, epoch {surface.epoch}", surface, out / "street.png")
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


def _learnt(client: Client, scans: Sequence[SimulatedScan], period_s: float) -> Intake:
    started = time.monotonic()
    published = ((ScanEntry(time.time_ns(), DEFAULT_SOURCE), scan) for scan in scans)
    due_s = [number * period_s for number in range(len(scans))] if period_s else ()
    publish_all(client, published, len(scans), due_s)
    flush = client.flush(FLUSH_TIMEOUT_S)
    taken_in = time.monotonic()
    status = wait_until_settled(client, _SETTLE_LIMIT_S)
    return Intake(
        scans=len(scans),
        taken=flush.taken,
        refused=flush.refused,
        lost=flush.lost,
        seconds=taken_in - started,
        learning_s=time.monotonic() - started,
        learnt_percent=status.learnt_percent,
        samples_trained=status.samples_trained,
    )
