"""Which tiles changed, by their triangles."""

import numpy as np
import pytest
from triquad_client import Mesh
from triquad_tools.benchmarks.mesh import changed_tiles

CELL_M = 0.1
TOLERANCE_M = 0.01
SIDE = 16


def plane(
    column: int, height_m: float = 0.0, shift_m: float = 0.0, length: int = SIDE
) -> tuple[tuple[int, int, int], Mesh]:
    """A level tile of cells; ``shift_m`` moves the vertices within the plane."""
    x, y = np.meshgrid(np.arange(length + 1), np.arange(SIDE + 1), indexing="ij")
    vertices = np.stack([x, y, np.zeros(x.shape)], -1).reshape(-1, 3) * CELL_M
    vertices += (column * SIDE * CELL_M + shift_m, 0, height_m)
    low = (np.arange(length)[:, None] * (SIDE + 1) + np.arange(SIDE)).reshape(-1)
    a, b, c, d = low, low + SIDE + 1, low + SIDE + 2, low + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return (column, 0, 0), Mesh(vertices, faces)


@pytest.mark.parametrize(
    ("second", "changed"),
    [
        (plane(1), False),
        (plane(1, height_m=0.8 * TOLERANCE_M), False),
        (plane(1, height_m=1.2 * TOLERANCE_M), True),
        (plane(1, shift_m=0.5 * CELL_M), False),  # other triangles of the same surface
        (plane(1, length=SIDE - 1), False),  # its end came and went by a cell
        (plane(1, length=SIDE - 3), True),
    ],
)
def test_a_tile_changes_where_its_surface_does(
    second: tuple[tuple[int, int, int], Mesh], changed: bool
) -> None:
    before = dict([plane(0), plane(1)])
    after = dict([plane(0), second])
    expected = {(1, 0, 0)} if changed else set()
    assert changed_tiles(before, after, TOLERANCE_M, 1.01 * CELL_M) == expected
    assert changed_tiles(after, before, TOLERANCE_M, 1.01 * CELL_M) == expected


def test_a_few_vertices_that_move_a_little_are_no_change() -> None:
    index, mesh = plane(0)
    uneven = mesh.vertices.copy()
    uneven[: len(uneven) // 3, 2] += 3 * TOLERANCE_M
    assert changed_tiles({index: mesh}, {index: Mesh(uneven, mesh.faces)}, 0.01, CELL_M) == set()
    uneven[7, 2] += 2 * CELL_M
    assert changed_tiles({index: mesh}, {index: Mesh(uneven, mesh.faces)}, 0.01, CELL_M) == {index}


def test_tiles_that_come_and_go_changed() -> None:
    both, one = dict([plane(0), plane(1)]), dict([plane(0)])
    assert changed_tiles(both, one, TOLERANCE_M, CELL_M) == {(1, 0, 0)}
    assert changed_tiles(one, both, TOLERANCE_M, CELL_M) == {(1, 0, 0)}
    assert changed_tiles({}, one, TOLERANCE_M, CELL_M) == {(0, 0, 0)}
    assert changed_tiles({}, {}, TOLERANCE_M, CELL_M) == set()
