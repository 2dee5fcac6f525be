from dataclasses import dataclass

import numpy as np
import pytest
from triquad_tools.evaluation.withheld_scores import score_withheld


@dataclass(frozen=True)
class Answer:
    sdf: np.ndarray
    status: np.ndarray


def test_withheld_points_are_scored_over_all_clouds() -> None:
    def query(points: np.ndarray) -> Answer:
        status = np.select([points[:, 0] < 5, points[:, 0] < 9], [2, 1], 0).astype(np.uint8)
        return Answer(np.where(points[:, 0] < 9, -0.01 * points[:, 0], np.nan), status)

    points = np.zeros((10, 3))
    points[:, 0] = np.arange(10)
    scores = score_withheld(query, [points[:3], points[:0], points[3:]])
    assert scores.points == 10
    assert (scores.surface_ratio, scores.unknown_ratio) == (0.5, 0.1)
    assert scores.sdf_median_m == pytest.approx(0.04)
    assert scores.sdf_p90_m == pytest.approx(0.08)
    assert scores.surface_sdf_median_m == pytest.approx(0.02)
    assert scores.surface_sdf_p90_m == pytest.approx(0.03)
