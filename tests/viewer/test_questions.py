"""What slices, borders of unknown space and paths say, against the map that they are of."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.maps.exact_maps import SEEN_M, exact_map, flat
from triquad_client import OfflineMap, Status
from triquad_tools.viewer.page.page import Focus, surface_along
from triquad_tools.viewer.questions.cell_box import CellBox
from triquad_tools.viewer.questions.clicks import Measure, Path
from triquad_tools.viewer.questions.slice import Slice, slider_places
from triquad_tools.viewer.questions.unknown_space import ask_boundary, border_faces
from triquad_tools.viewer.view_panel import round_length, turned_back

GROUND_M = 0.1  # in the middle of a voxel
ROOM = np.array([[0.0, 0, 0], [5, 4, 2.5]])  # [2, 3] its corners
FOCUS = Focus(np.array([0.3, -0.4, 1.2]), 16.0)


@pytest.fixture(scope="module")
def ground() -> Iterator[OfflineMap]:
    """Flat ground, free up to 2 m above it, seen within 10 m."""
    with OfflineMap(exact_map(flat(GROUND_M))) as opened:
        yield opened


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_is_asked_and_drawn_where_it_is(ground: OfflineMap, axis: int) -> None:
    cut = Slice.around(FOCUS, axis, 0.9, 3.0)
    box = cut.box
    cells = np.random.default_rng(axis).integers(0, box.counts, (50, 3))
    places = box.places(cells + 0.5)
    np.testing.assert_allclose(places[:, axis], 0.9)
    found, asked = box.ask(ground, 3.0), ground.query_distance(places, 3.0)
    # Points travel in single precision, from another origin.
    np.testing.assert_allclose(found.distance_m[tuple(cells.T)], asked.distance_m, atol=1e-4)
    assert np.linalg.det(cut.turn) == pytest.approx(1.0)
    across, up = np.delete(box.size_m, axis)
    middle = box.places(0.5 * np.array(box.counts))
    corner = middle + cut.turn @ [-0.5 * across, -0.5 * up, 0.0]
    expected = np.array(box.corner)
    expected[axis] = 0.9
    np.testing.assert_allclose(corner, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("extent", "wanted_m", "places"),
    [
        (ROOM, 1.0, (-0.5, 1.0, 3.0)),  # a tenth of its five metres beyond floor and ceiling
        (ROOM, 900.0, (-0.5, 3.0, 3.0)),
        (10 * ROOM, 5.0, (-5.0, 5.0, 25.0)),
        (100 * ROOM, 50.0, (30.0, 50.0, 70.0)),
        (np.zeros((2, 3)), 0.75, (-0.05, 0.05, 0.05)),
        (None, 4.0, (-16.0, 4.0, 24.0)),
    ],
)
def test_a_slice_moves_as_far_as_the_map_goes(
    extent: np.ndarray | None, wanted_m: float, places: tuple[float, float, float]
) -> None:
    assert slider_places(extent, 2, wanted_m) == pytest.approx(places)


@pytest.mark.parametrize(("beyond_m", "is_met"), [(-0.5, True), (0.15, True), (1.0, False)])
def test_a_click_snaps_to_surface_within_a_voxel(
    ground: OfflineMap, beyond_m: float, is_met: bool
) -> None:
    page = SimpleNamespace(
        source=SimpleNamespace(queries=ground, sizes=SimpleNamespace(cell_m=0.5 * ground.leaf_m)),
        focus=FOCUS,
        eye=np.array([0.0, 0, 5]),
        top_m=1.0,
    )
    origin = np.array([SEEN_M + beyond_m, 0.03, 1.5])
    met = surface_along(page, origin, np.array([0.0, 0, -2]))  # type: ignore[arg-type]
    assert (met is not None) == is_met
    page.top_m = GROUND_M - 0.05
    cut = surface_along(page, origin, np.array([0.0, 0, -2]))  # type: ignore[arg-type]
    assert cut is None, "what is not drawn is not met"
    if met is not None:
        assert abs(met[2] - GROUND_M) < 0.05
        assert np.linalg.norm(met[:2] - origin[:2]) <= ground.leaf_m + 1e-6


def test_a_length_has_a_level_and_an_upright_part() -> None:
    start = np.array([450_000.0, -2.0, 1.0])
    html = Measure(start, start + [3.0, 4.0, -12.0]).html()
    for told in ("13.000 m", "5.000 m", "-12.000 m"):
        assert told in html


@given(st.floats(1e-3, 1e6))
def test_a_scale_is_a_round_length_that_fits(most_m: float) -> None:
    length_m = round_length(most_m)
    assert 0.39 * most_m < length_m <= most_m * (1 + 1e-9)
    assert f"{length_m:.3e}"[:5] in ("1.000", "2.000", "5.000")


@pytest.mark.parametrize("back", [(3.0, -4, 12), (0, 0, 5), (0, 0, -5), (-1, 0, 0)])
def test_a_view_from_a_side_keeps_its_distance(back: tuple[float, float, float]) -> None:
    for level in (True, False):
        turned = turned_back(np.array(back), level=level)
        assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(back))
        rise_deg = np.degrees(np.arcsin(turned[2] / np.linalg.norm(turned)))
        assert 3 < rise_deg < 8 if level else rise_deg > 89.9
        if back[0]:
            across = turned[0] * back[1] - turned[1] * back[0]
            assert across == pytest.approx(0.0, abs=1e-9), "it is not turned round"


@given(st.integers(0, 2**32 - 1))
def test_borders_lie_between_free_and_unknown_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    status = rng.integers(0, 3, rng.integers(1, 5, 3)).astype(np.uint8)
    cells, steps = border_faces(status)
    pairs = set(zip(map(tuple, cells.tolist()), map(tuple, steps.tolist()), strict=True))
    expected = set()
    for cell in np.ndindex(*status.shape):
        for step in [*np.eye(3, dtype=int), *-np.eye(3, dtype=int)]:
            beyond = np.array(cell) + step
            inside = (beyond >= 0).all() and (beyond < status.shape).all()
            if inside and (status[cell], status[tuple(beyond)]) == (Status.FREE, Status.UNKNOWN):
                expected.add((cell, tuple(step.tolist())))
    assert pairs == expected
    assert len(cells) == len(expected)


def test_ground_is_no_border_of_unknown_space_however_coarse_the_cells(ground: OfflineMap) -> None:
    box = CellBox.around(np.array([0.1, 0.1, 0.1]), 0.75, (64, 64, 24))
    cells, steps, epoch = ask_boundary(ground, box)
    assert epoch == ground.epoch
    middles = box.places(cells + 0.5 + 0.5 * steps)
    inside = np.abs(middles[:, :2]).max(axis=1) < SEEN_M - box.cell_m
    assert inside.any()
    # All that is seen lies below the sky, and on the ground.
    assert (steps[inside] == [0, 0, 1]).all()


def path(ground: OfflineMap, radius_m: float, *points: tuple[float, float, float]) -> Path:
    return Path(ground, np.array(points), radius_m)


def test_a_path_is_blocked_where_the_map_says(ground: OfflineMap) -> None:
    points = [(-3.0, 0.0, 1.0), (3.0, 0.0, 1.0), (3.0, 3.0, -1.0)]
    laid = path(ground, 0.25, *points)
    answer = laid.answer
    assert answer == ground.query_polyline(np.array(points), 0.25, 1.0)
    assert answer.blocked
    assert f"at {answer.contact_m:.2f} m" in laid.html()
    (passed, free), (touching, blocked) = laid.legs()
    assert passed != touching
    np.testing.assert_allclose(blocked[0], free[-1])
    np.testing.assert_allclose(blocked[0][2], GROUND_M + 0.25, atol=0.1)
    lengths = [np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in (free, blocked)]
    assert lengths[0] == pytest.approx(answer.contact_m, abs=1e-4)
    assert sum(lengths) == pytest.approx(answer.length_m, abs=1e-4)
    assert any(np.allclose(place, points[1]) for place in free), "corners are kept"
    assert path(ground, 50.0, (-1.0, 0.0, 1.0), (1.0, 0.0, 1.0)).answer.blocked, "a large robot"
