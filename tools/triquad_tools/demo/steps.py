"""The steps of the demonstration, each against a running server."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client, Mesh, connect

from triquad_tools.console.progress import progress
from triquad_tools.demo.probe import Probe, ProbeReport
from triquad_tools.demo.results import Intake
from triquad_tools.evaluation.map_scores import DrivenStreet, StreetScores, score_street
from triquad_tools.evaluation.metrics import (
    STREET_VOXEL_M,
    MeshScores,
    ScoreSettings,
    score_against_scene,
    scored_box,
)
from triquad_tools.plots.picture import draw_mesh
from triquad_tools.recordings.publishing import publish_all, wait_until_settled

MAP = "demo"

_SEED = 0  # of the points that are asked
_SETTLE_LIMIT_S = 70.0
_QUERY_POINTS = 1_000


@dataclass(frozen=True)
class Learnt:
    """The results of a server that integrated a street while it was queried."""

    intake: Intake
    queries: ProbeReport


@dataclass(frozen=True)
class Scored:
    """The map against the exact street."""

    street: StreetScores
    mesh: MeshScores
    parameters: int


def learn(endpoint: str, street: DrivenStreet) -> Learnt:
    """Stream the scans and wait until they are learnt, while another process asks."""
    points = np.random.default_rng(_SEED).permutation(street.probes.near)[:_QUERY_POINTS]
    with connect(endpoint, MAP) as client, Probe(endpoint, MAP, points) as probe:
        intake = _stream(client, street)
        return Learnt(intake, probe.finish())


def score(endpoint: str, street: DrivenStreet, out: Path) -> Scored:
    """Compare the map with the exact street; leave the map, its mesh and a picture in a folder."""
    settings, visible = ScoreSettings(), street.drive.true_hits(STREET_VOXEL_M)
    with connect(endpoint, MAP) as client, progress("scoring") as report:
        report(0.0, "distances")
        field = score_street(client.query_sdf, street.probes)
        report(0.0, "mesh")
        surface = client.mesh(scored_box(visible, settings))
        client.download_map(out / "map.triquad")
        parameters = client.status().parameters
        report(0.0, "mesh against the exact surface")
        scores = score_against_scene(surface, street.drive.scene, visible, settings)
        report(0.0, f"{scores.samples:,} samples of the mesh")
    _draw(surface, out)
    return Scored(field, scores, parameters)


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
