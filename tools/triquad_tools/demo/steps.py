"""The steps of the demonstration, each against a running server."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import CheckpointInfo, Client, Mesh, SdfResult, connect
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_format.records.crop import without_training
from triquad_map.preview import previews_of

from triquad_tools.console.progress import progress
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.demo.results import Intake, MapSize, Restart
from triquad_tools.evaluation.map_scores import DrivenStreet, StreetScores, score_street
from triquad_tools.evaluation.metrics import (
    STREET_SETTINGS,
    MeshScores,
    compare_mesh,
    drive_truth,
    scored_box,
)
from triquad_tools.plots.picture import draw_mesh
from triquad_tools.recordings.publishing import publish_all, wait_until_settled

MAP = "demo"

_SEED = 0  # of the points that are asked
_SETTLE_LIMIT_S = 70.0
_QUERY_POINTS = 1_000
_RESTART_POINTS = 50_000


@dataclass(frozen=True)
class Learnt:
    """The results of a server that integrated a street while it was queried."""

    intake: Intake
    queries: ProbeReport


@dataclass(frozen=True)
class Scored:
    """The scores of the map, and what the server said before it was stopped."""

    street: StreetScores
    mesh: MeshScores
    surface: Mesh
    parameters: int
    checkpoint: CheckpointInfo
    points: Doubles  # [N, 3] where it was asked
    answers: SdfResult


def learn(endpoint: str, street: DrivenStreet) -> Learnt:
    """Stream the scans and wait until they are learnt, while another process asks."""
    points = np.random.default_rng(_SEED).permutation(street.probes.near)[:_QUERY_POINTS]
    with connect(endpoint, MAP) as client, Probe(endpoint, MAP, points) as probe:
        intake = _stream(client, street)
        return Learnt(intake, probe.finish())


def _stream(client: Client, street: DrivenStreet) -> Intake:
    started = time.monotonic()
    flush = publish_all(client, street.scans)
    taken_in = time.monotonic()
    status = wait_until_settled(client, _SETTLE_LIMIT_S)
    return Intake(
        scans=len(street.scans),
        taken=flush.taken,
        refused=flush.refused,
        lost=flush.lost,
        points=sum(len(scan.points) for scan in street.scans),
        seconds=taken_in - started,
        learning_s=time.monotonic() - started,
        settled=status.settled,
        samples_trained=status.samples_trained,
    )


def score(endpoint: str, street: DrivenStreet) -> Scored:
    """Compare the map with the exact street, and have the server write it to its store."""
    rng = np.random.default_rng(_SEED)
    points = rng.permutation(street.probes.near)[:_RESTART_POINTS]
    with connect(endpoint, MAP) as client, progress("scoring") as report:
        report(0.0, "distances")
        field = score_street(client.query_sdf, street.probes)
        report(0.0, "mesh")
        truth = drive_truth(street.drive, STREET_SETTINGS)
        surface = client.mesh(scored_box(truth.points, STREET_SETTINGS))
        checkpoint = client.checkpoint()
        answers = client.query_sdf(points)
        parameters = client.status().parameters
        report(0.0, "mesh against the exact surface")
        scores = compare_mesh(surface, truth, STREET_SETTINGS).scores
        report(0.0, f"{scores.samples:,} samples of the mesh")
    return Scored(
        street=field,
        mesh=scores,
        surface=surface,
        parameters=parameters,
        checkpoint=checkpoint,
        points=points,
        answers=answers,
    )


def compare(endpoint: str, scored: Scored) -> Restart:
    """Ask a restarted server what was asked before."""
    with connect(endpoint, MAP) as client:
        answers = client.query_sdf(scored.points)
    change = np.abs(answers.sdf - scored.answers.sdf)
    return Restart(
        points=len(change),
        sdf_difference_max_m=float(change.max()) if len(change) else 0.0,
        statuses_changed=int((answers.status != scored.answers.status).sum()),
    )


def pack(scored: Scored, path: Path) -> MapSize:
    """Write the map without the state that only training needs."""
    record = without_training(read_map(scored.checkpoint.path))
    packed = write_map(record, path, previews=previews_of(record))
    return MapSize(packed.bytes, scored.checkpoint.bytes, scored.parameters)


def draw(surface: Mesh, paths: Sequence[Path], picture: Path) -> None:
    """Save the mesh, and a picture of it."""
    with progress("drawing") as report:
        for path in paths:
            report(0.0, path.name)
            surface.save(path)
        report(0.0, picture.name)
        draw_mesh(f"map {MAP!r}, epoch {surface.epoch}", surface, picture)
