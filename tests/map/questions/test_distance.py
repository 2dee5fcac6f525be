"""Distances near a surface, where the field and what the rays have shown do not agree."""

from dataclasses import dataclass

import numpy as np
import pytest
from support.maps.exact_view import ExactView
from triquad_map.questions.distance import distances
from triquad_map.view import FieldAnswer
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import half_space


@dataclass(frozen=True)
class FlatField(ExactView):
    """A floor whose field was hardly trained: it is a little below zero everywhere."""

    def query(self, points, gradient=False):
        exact = super().query(points, gradient)
        return FieldAnswer(np.full_like(exact.sdf, -0.005), exact.status, exact._gradient)


@pytest.fixture
def floor():
    bounds = np.array([[-5.0, -5, -5], [5, 5, 5]])
    return FlatField(Scene((half_space(0.0),), bounds), np.eye(4), *bounds)


@pytest.mark.parametrize("height_m", [0.15, 0.17, 0.19])
def test_no_place_that_rays_passed_is_behind_a_surface_a_voxel_away(floor, height_m):
    answer = distances(floor, np.array([[0.0, 0, height_m], [0, 0, -height_m]]))
    before, behind = answer.distance_m
    assert 0 < before <= height_m
    assert -height_m <= behind < 0
    assert (answer.gradient[:, 2] > 0.99).all()
