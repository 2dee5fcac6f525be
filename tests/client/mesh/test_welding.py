from dataclasses import replace

import numpy as np
from triquad_map.triangles import TileJoin, Triangles, joined

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)


def of(*corners):
    """The mesh of a tile with one triangle."""
    return Triangles(np.array(corners, np.float64), np.array([[0, 1, 2]], np.int32))


def test_rounding_boundaries_do_not_leave_cracks():
    rng = np.random.default_rng(0)
    edge = np.stack([np.full(2000, 6.4), rng.uniform(0, 6.4, 2000), np.full(2000, 0.3)], axis=1)
    edge[:, 1] = np.round(edge[:, 1] / 1e-3) * 1e-3 + 0.5e-4  # on boundaries of the rounding
    edge = np.unique(edge, axis=0)
    copy = edge + rng.normal(0, 1e-7, edge.shape) * (0, 1, 0)
    count = len(edge)
    index = np.arange(count - 1)
    fan = np.stack([index, index + 1, np.full(count - 1, count)], axis=1).astype(np.int32)
    left = Triangles(np.concatenate([edge, [[6.0, 3.0, 0.5]]]), fan)
    right = Triangles(np.concatenate([copy, [[6.8, 3.0, 0.5]]]), fan[:, ::-1])
    mesh = joined([left, right], 6.4, box=EVERYWHERE)
    assert len(mesh.vertices) == count + 2


def test_faces_that_become_degenerate_are_left_out():
    join = TileJoin(1.0, EVERYWHERE, marked=True)
    join.add(of([1, 0, 0], [1, 1e-6, 0], [0.5, 0.5, 0.5]))
    join.add(replace(of([1, 0, 0], [1, 1, 0], [1.5, 0.5, 0.5]), filled=np.array([True])))
    mesh = join.mesh()
    assert mesh.faces.shape == (1, 3)
    assert len(mesh.vertices) == 3
    assert mesh.filled.tolist() == [True]


def test_faces_out_of_the_box_go_with_their_vertices():
    tile = Triangles(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [3, 1, 0]], np.float64) + 0.1,
        np.array([[0, 1, 2], [1, 3, 4]], np.int32),
    )
    mesh = joined([tile], 6.4, box=(np.zeros(3), np.full(3, 1.4)))
    np.testing.assert_allclose(mesh.vertices, tile.vertices[:3])
    assert mesh.faces.tolist() == [[0, 1, 2]]
