"""A map record as the parts of a map file: a sequence of msgpack maps.

``docs/map-file.md`` is the specification; :mod:`triquad_format.part_reader` is the way back.
"""

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.array import pack_array
from triquad_format.errors import FormatError
from triquad_format.field_settings import FieldSettings
from triquad_format.region import Evidence, MapRecord, Region, TrainingState, VertexTable

PREFIX = "/triquad/"
MAP = "/triquad/map"
REGION = "/triquad/region"
VERTICES = "/triquad/vertices"
EVIDENCE = "/triquad/evidence"
TRAINING = "/triquad/training"
MOMENTS = "/triquad/moments"
SAMPLES = "/triquad/samples"
MANIFEST = "/triquad/manifest"
TOPICS = (MAP, REGION, VERTICES, EVIDENCE, TRAINING, MOMENTS, SAMPLES, MANIFEST)

FRAME_ID = "map"
UNITS = "m"

MAX_CODE_BYTES = 6
"""Bytes of the widest difference between two neighbouring Morton codes."""

ROWS_PER_PART = 1 << 18
"""Rows of the largest part: of the widest rows that settings allow, they fill 131 MiB."""

FEATURE_DTYPES = ("<f2", "<f4")


@dataclass(frozen=True)
class Part:
    """One part of a map file."""

    topic: str
    payload: bytes  # a msgpack map


def pack_record(record: MapRecord, feature_dtype: str) -> Iterator[Part]:
    """The parts of a checked record in the order of the file, without the manifest.

    Raises:
        FormatError: features do not fit ``feature_dtype``.
    """
    yield _part(
        MAP,
        {
            "name": record.name,
            "epoch": record.epoch,
            "frame_id": FRAME_ID,
            "units": UNITS,
            "regions": len(record.regions),
            "settings": _pack_settings(record.settings),
        },
    )
    for region in record.regions:
        yield from _pack_region(region, feature_dtype)


def pack_manifest(entries: list[tuple[str, int, bytes]]) -> Part:
    """The last part: topic, length and SHA-256 of every part before it."""
    parts = [{"topic": topic, "bytes": size, "sha256": sha} for topic, size, sha in entries]
    return _part(MANIFEST, {"parts": parts})


def shuffle(array: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Bytes ``[B, ...]`` of an array ``[...]`` of ``B``-byte values, little endian.

    Row ``k`` holds byte ``k`` of every value: bytes of one significance resemble each other, so
    they compress better side by side.
    """
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    size = little.dtype.itemsize
    values = np.frombuffer(little.tobytes(), np.uint8).reshape(*array.shape, size)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


def unshuffle(planes: NDArray[np.uint8], dtype: str) -> NDArray[np.generic]:
    """The inverse of :func:`shuffle`."""
    values = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
    return np.frombuffer(values.data, dtype).reshape(planes.shape[1:])


def shuffle_codes(codes: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Shuffled differences ``[B, V]`` of increasing codes ``[V]``, in as few bytes as hold them."""
    differences = np.diff(codes, prepend=np.int64(0))
    width = (int(differences.max(initial=1)).bit_length() + 7) // 8
    return shuffle(differences)[:width]


def unshuffle_codes(planes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The inverse of :func:`shuffle_codes`; it takes at most ``MAX_CODE_BYTES`` rows.

    Differences this small cannot pass over the negative numbers, so that codes which overflow
    are seen to decrease.
    """
    wide = np.zeros((8, planes.shape[1]), np.uint8)
    wide[: len(planes)] = planes
    return np.cumsum(unshuffle(wide, "<i8").astype(np.int64), dtype=np.int64)


def _part(topic: str, body: Mapping[str, object]) -> Part:
    return Part(topic, typing.cast(bytes, msgpack.packb(body)))


def _pack_settings(settings: FieldSettings) -> dict[str, object]:
    values = dataclasses.asdict(settings)
    hints = typing.get_type_hints(FieldSettings)
    return {name: hints[name](value) for name, value in values.items()}


def _pack_region(region: Region, feature_dtype: str) -> Iterator[Part]:
    index = list(region.index)
    yield _part(
        REGION,
        {
            "region": index,
            "frequencies": pack_array(region.frequencies),
            "weights": [pack_array(weight) for weight in region.mlp.weights],
            "biases": [pack_array(bias) for bias in region.mlp.biases],
            "vertices": [len(table.codes) for table in region.tables],
            "blocks": len(region.evidence.codes),
            "training": region.training is not None,
        },
    )
    for table in region.tables:
        yield from _pack_table(index, table, feature_dtype)
    yield from _pack_evidence(index, region.evidence)
    if region.training is not None:
        yield from _pack_training(index, region.tables, region.training)


def _portions(count: int) -> Iterator[slice]:
    """The rows of each part of a table of ``count`` rows; an empty table has one part."""
    for first in range(0, max(count, 1), ROWS_PER_PART):
        yield slice(first, first + ROWS_PER_PART)


def _pack_table(index: list[int], table: VertexTable, feature_dtype: str) -> Iterator[Part]:
    with np.errstate(over="ignore"):
        features = table.features.astype(feature_dtype)
    if not np.isfinite(features).all():
        raise FormatError(
            f"region {index}: features of plane {table.plane}, level {table.level} reach "
            f"{np.abs(table.features).max()}, which {feature_dtype} does not hold; use '<f4'",
        )
    for rows in _portions(len(table.codes)):
        body = {
            "region": index,
            "plane": table.plane,
            "level": table.level,
            "codes": pack_array(shuffle_codes(table.codes[rows])),
            "features": pack_array(shuffle(features[rows])),
        }
        yield _part(VERTICES, body)


def _pack_evidence(index: list[int], evidence: Evidence) -> Iterator[Part]:
    for rows in _portions(len(evidence.codes)):
        body = {
            "region": index,
            "codes": pack_array(shuffle_codes(evidence.codes[rows])),
            "surface": pack_array(evidence.surface[rows]),
            "free": pack_array(evidence.free[rows]),
        }
        yield _part(EVIDENCE, body)


def _pack_training(
    index: list[int], tables: tuple[VertexTable, ...], training: TrainingState
) -> Iterator[Part]:
    count = len(training.sample_points)
    yield _part(
        TRAINING,
        {
            "region": index,
            "mlp_means": [pack_array(mean) for mean in training.mlp_means],
            "mlp_variances": [pack_array(variance) for variance in training.mlp_variances],
            "mlp_steps": training.mlp_steps,
            "visits_owed": training.visits_owed,
            "samples": count,
        },
    )
    for number, table in enumerate(tables):
        for rows in _portions(len(table.codes)):
            body = {
                "region": index,
                "plane": table.plane,
                "level": table.level,
                "means": pack_array(shuffle(training.table_means[number][rows])),
                "variances": pack_array(shuffle(training.table_variances[number][rows])),
                "steps": pack_array(shuffle(training.table_steps[number][rows])),
            }
            yield _part(MOMENTS, body)
    for rows in _portions(count):
        body = {
            "region": index,
            "points": pack_array(shuffle(training.sample_points[rows])),
            "labels": pack_array(shuffle(training.sample_labels[rows])),
        }
        yield _part(SAMPLES, body)
