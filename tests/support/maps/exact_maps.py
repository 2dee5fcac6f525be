"""Maps whose field is exact: a ground of any height, seen from above."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from support.maps.map_records import blocks_of, evidence_of, masks
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    Evidence,
    MapRecord,
    Mlp,
    Region,
    TrainingState,
    VertexTable,
)

Height = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

SETTINGS = FieldSettings(
    leaf_m=0.2, depth=7, feature_levels=1, feature_size=1, frequencies=1, hidden=2,
    encoding="features", logit_scale_m=1.0,
)  # fmt: skip
"""One region of 25.6 m, of which it answers for 22.4 m."""

SEEN_M = 10.0
"""The ground is seen in a square from minus to plus this."""

_SEEN_ABOVE = 10  # free voxels over the ground
_VERTICES = (1 << SETTINGS.depth) + 1


def flat(height_m: float) -> Height:
    return lambda x, y: np.full(np.broadcast(x, y).shape, height_m)


def table(
    low_m: float, high_m: float, side_m: float = 4.0, at: tuple[float, float] = (0.0, 0.0)
) -> Height:
    """A ground at ``low_m`` with a square around ``at``, ``side_m`` long, at ``high_m``."""

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = np.maximum(np.abs(x - at[0]), np.abs(y - at[1])) < side_m / 2
        return np.where(inside, high_m, low_m)

    return height


def exact_map(height: Height, epoch: int = 1, label_error_m: float | None = None) -> MapRecord:
    """A map whose signed distance is the height over the ground, exact at the leaves' corners.

    With ``label_error_m`` it has replay samples on the ground, whose labels are off by that.
    """
    places = np.arange(_VERTICES) * SETTINGS.leaf_m - SETTINGS.region_side_m / 2
    cells = np.stack(np.meshgrid(np.arange(_VERTICES), np.arange(_VERTICES)), axis=-1)
    codes = np.sort(morton.encode(cells.reshape(-1, 2)))
    first, second = morton.decode(codes, 2).T
    features = (-height(places[first], places[second]), places[second])  # over XY, over XZ
    tables = tuple(
        VertexTable(plane, SETTINGS.depth, codes, values.astype(np.float32)[:, None])
        for plane, values in enumerate(features)
    )
    nothing = VertexTable(2, SETTINGS.depth, codes[:0], np.zeros((0, 1), np.float32))
    region = Region(
        index=(0, 0, 0),
        frequencies=np.zeros(1, np.float32),
        mlp=_identity(),
        tables=(*tables, nothing),
        evidence=_evidence(height),
        training=None if label_error_m is None else _training(tables, height, label_error_m),
    )
    return MapRecord("ground", epoch, SETTINGS, (region,))


def _identity() -> Mlp:
    """Gives what it gets: the positive part less the negative one."""
    both = np.array([[1.0, -1.0]], np.float32)
    zeros = np.zeros(2, np.float32)
    return Mlp((both, np.eye(2, dtype=np.float32), both.T.copy()), (zeros, zeros, zeros[:1]))


def _evidence(height: Height) -> Evidence:
    """The voxels that hold the ground, and those above them."""
    half = 1 << (SETTINGS.depth - 1)
    reach = round(SEEN_M / SETTINGS.leaf_m)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-reach, reach)] * 2))
    ground = height((x + 0.5) * SETTINGS.leaf_m, (y + 0.5) * SETTINGS.leaf_m)
    z = np.floor(ground / SETTINGS.leaf_m).astype(np.int64)
    surface = np.stack([x, y, z], axis=1) + half
    free = np.concatenate([surface + [0, 0, up] for up in range(1, _SEEN_ABOVE + 1)])
    codes = blocks_of(np.concatenate([surface, free]))
    return evidence_of(codes, masks(codes, surface), masks(codes, free))


def _training(
    tables: tuple[VertexTable, ...], height: Height, label_error_m: float
) -> TrainingState:
    places = np.random.default_rng(0).uniform(-SEEN_M, SEEN_M, (2000, 2))
    ground = height(places[:, 0], places[:, 1])
    sizes = [len(tables[0].codes), len(tables[1].codes), 0]
    zeros = tuple(np.zeros((size, 1), np.float32) for size in sizes)
    mlp = _identity()
    return TrainingState(
        table_means=zeros,
        table_variances=zeros,
        table_steps=tuple(np.zeros(size, np.int32) for size in sizes),
        mlp_means=(*mlp.weights, *mlp.biases),
        mlp_variances=tuple(np.zeros_like(array) for array in (*mlp.weights, *mlp.biases)),
        mlp_steps=0,
        sample_points=np.column_stack([places, ground]).astype(np.float32),
        sample_labels=np.full(len(places), label_error_m, np.float32),
        budget_samples=0,
    )
