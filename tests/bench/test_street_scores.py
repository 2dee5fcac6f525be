from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from triquad_format.records.status import Status
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.street import street_drive

from bench.street_scores import HOUSE_MARGIN_M, NEAR_M, StreetProbes, score_street, street_probes

DRIVE = street_drive(3, 2)


@dataclass(frozen=True)
class Answer:
    sdf: np.ndarray
    status: np.ndarray
    gradient: np.ndarray | None = None


@pytest.fixture(scope="module")
def probes() -> StreetProbes:
    return street_probes(DRIVE, np.random.default_rng(0))


def _exact(scene: Scene, offset_m: float = 0.0, known: bool = False) -> Callable[..., Answer]:
    """A map that knows the scene but for an offset, and its houses only where ``known``."""

    def query(points: np.ndarray, gradient: bool = False) -> Answer:
        inside = scene.is_inside_house(points, HOUSE_MARGIN_M) & (not known)
        status = np.where(inside, Status.UNKNOWN, Status.SURFACE).astype(np.uint8)
        return Answer(scene.sdf(points) + offset_m, status, scene.gradient(points))

    return query


def test_probes_lie_near_the_surface_and_deep_in_houses(probes: StreetProbes) -> None:
    assert len(probes.near) > 10_000
    assert np.abs(probes.exact_sdf).max() <= NEAR_M + 1e-9
    assert np.abs(probes.exact_sdf).mean() == pytest.approx(0.5 * NEAR_M, rel=0.1)
    assert np.mean(probes.exact_sdf > 0.0) == pytest.approx(0.5, abs=0.1)
    assert DRIVE.scene.is_exact(probes.near).all()
    assert len(probes.in_houses) > 1_000
    assert DRIVE.scene.is_inside_house(probes.in_houses, HOUSE_MARGIN_M).all()
    assert probes.in_houses[:, 2].min() > 0.0


def test_an_exact_map_has_no_errors(probes: StreetProbes) -> None:
    scores = score_street(_exact(DRIVE.scene), probes)
    assert scores.sdf_error_m == pytest.approx(0.0, abs=1e-9)
    assert scores.gradient_angle_deg == pytest.approx(0.0, abs=1e-3)
    assert scores.houses_unknown_ratio == 1.0


def test_an_offset_is_the_error_and_ghosts_in_houses_are_counted(probes: StreetProbes) -> None:
    scores = score_street(_exact(DRIVE.scene, offset_m=-0.03, known=True), probes)
    assert scores.sdf_error_m == pytest.approx(0.03)
    assert scores.houses_unknown_ratio == 0.0


def test_an_empty_map_scores_nothing(probes: StreetProbes) -> None:
    def query(points: np.ndarray, gradient: bool = False) -> Answer:
        nothing = np.full(len(points), np.nan, np.float32)
        return Answer(nothing, np.zeros(len(points), np.uint8), np.tile(nothing[:, None], 3))

    scores = score_street(query, probes)
    assert np.isnan([scores.sdf_error_m, scores.gradient_angle_deg]).all()
    assert scores.houses_unknown_ratio == 1.0
