import numpy as np
from triquad_client.mesh.mesh import compacted
from triquad_client.mesh.tile_join import on_sides, welded


def test_vertices_on_a_common_face_become_one():
    # Two triangles in the tiles left and right of x = 1, which share an edge on that face.
    left = np.array([[0.5, 0.5, 0.5], [1, 0.2, 0.3], [1, 0.8, 0.3]])
    right = np.array([[1, 0.2, 0.3], [1, 0.8, 0.3], [1.5, 0.5, 0.5]])
    faces = np.array([[0, 1, 2], [3, 5, 4]], np.int32)
    vertices = np.concatenate([left, right])
    mesh = welded(vertices, faces, on_sides(vertices, 1.0))
    assert len(mesh.vertices) == 4
    assert len(mesh.faces) == 2
    assert len(set(mesh.faces.ravel())) == 4


def test_rounding_boundaries_do_not_leave_cracks():
    rng = np.random.default_rng(0)
    edge = np.stack([np.full(2000, 6.4), rng.uniform(0, 6.4, 2000), np.full(2000, 0.3)], axis=1)
    edge[:, 1] = np.round(edge[:, 1] / 1e-3) * 1e-3 + 0.5e-4  # on boundaries of the rounding
    edge = np.unique(edge, axis=0)
    copy = edge + rng.normal(0, 1e-7, edge.shape) * (0, 1, 0)
    apexes = np.array([[6.0, 3.0, 0.5], [6.8, 3.0, 0.5]])
    count = len(edge)
    index = np.arange(count - 1)
    first = np.stack([index, index + 1, np.full(count - 1, 2 * count)], axis=1)
    second = np.stack([index + 1, index, np.full(count - 1, count + 1)], axis=1) + count
    vertices = np.concatenate([edge, copy, apexes])
    faces = np.concatenate([first, second]).astype(np.int32)
    mesh = welded(vertices, faces, on_sides(vertices, 6.4))
    assert len(mesh.vertices) == count + 2


def test_faces_that_become_degenerate_are_left_out():
    vertices = np.array([[1, 0, 0], [1, 1e-6, 0], [0.5, 0.5, 0.5]])
    mesh = welded(vertices, np.array([[0, 1, 2]], np.int32), on_sides(vertices, 1.0))
    assert mesh.faces.shape == (0, 3)


def test_an_empty_mesh_stays_empty():
    vertices = np.zeros((0, 3))
    mesh = welded(vertices, np.zeros((0, 3), np.int32), on_sides(vertices, 6.4))
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)
    assert mesh.faces.dtype == np.int32


def test_unused_vertices_go():
    mesh = compacted(np.arange(12.0).reshape(4, 3), np.array([[3, 1, 0]]))
    assert np.array_equal(mesh.vertices, [[0, 1, 2], [3, 4, 5], [9, 10, 11]])
    assert np.array_equal(mesh.faces, [[2, 1, 0]])
