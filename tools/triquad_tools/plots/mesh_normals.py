"""Which way a mesh faces at its vertices."""

import numpy as np
from triquad_format.records.arrays import Doubles, Ints


def vertex_normals(vertices: Doubles, faces: Ints) -> Doubles:
    """Unit normals ``[V, 3]``: those of the faces around a vertex, weighted by their area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    shares = [np.bincount(faces.ravel(), part, len(vertices)) for part in across.repeat(3, 0).T]
    normals: Doubles = np.stack(shares, axis=1).astype(np.float64)  # integers of no face
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals
