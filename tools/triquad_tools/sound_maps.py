"""Small sound map files of every kind, to be spoilt by :mod:`triquad_tools.fuzz_maps`."""

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.map_facts import MapFacts
from triquad_format.mapfile.mapfile import read_map_file, write_map
from triquad_format.mapfile.writer import record_parts, write_parts
from triquad_format.records import morton
from triquad_format.records.evidence_voxels import surface_counts
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    BLOCK_VOXELS,
    MAX_LEVEL,
    Evidence,
    MapRecord,
    Mlp,
    Region,
    TrainingState,
    VertexTable,
)

_SETTINGS = FieldSettings(
    depth=6, feature_levels=1, feature_size=2, frequencies=1, hidden=2, logit_scale_m=0.5
)
_POINTS = 3
_SCALE = 2.0**-7


@dataclass(frozen=True)
class SoundMap:
    """A map file, and those that it needs, in a folder of their own."""

    kind: str
    record: MapRecord
    folder: Path
    name: str  # of the file that is opened
    files: dict[str, bytes]  # of the folder

    @property
    def path(self) -> Path:
        """The file that is opened."""
        return self.folder / self.name


def sound_maps(folder: Path, given: Sequence[Path]) -> list[SoundMap]:
    """Maps of every kind, written into a folder; ``given`` are more of them."""
    plain = _record(training=False)
    kinds = {
        "complete": plain,
        "training": _record(training=True),
        "integers": _with_integers(plain),
        "levels": _with_levels(plain),
    }
    maps = [_complete(folder / kind, kind, record) for kind, record in kinds.items()]
    maps.append(_delta(folder / "delta", plain))
    maps.extend(_copied(folder / f"given-{i}", path) for i, path in enumerate(given))
    return maps


def _complete(folder: Path, kind: str, record: MapRecord) -> SoundMap:
    folder.mkdir()
    write_map(record, folder / "map.triquad", preview=kind == "complete")
    return _found(folder, kind, "map.triquad")


def _delta(folder: Path, base: MapRecord) -> SoundMap:
    folder.mkdir()
    facts = MapFacts(base.name, base.epoch, base.settings)
    first = write_parts(
        folder / "base.triquad", facts, 10**9, record_parts(base, "<f2", None, 0), {}
    )
    known = first.manifest.elsewhere(FileRef("base.triquad", first.manifest_sha256))
    later = dataclasses.replace(_with_integers(base), epoch=base.epoch + 1)
    facts = dataclasses.replace(facts, epoch=later.epoch)
    parts = record_parts(later, "<f2", None, 0)
    write_parts(folder / "map.triquad", facts, 2 * 10**9, parts, known)
    return _found(folder, "delta", "map.triquad")


def _copied(folder: Path, path: Path) -> SoundMap:
    folder.mkdir()
    shutil.copy(path, folder)
    manifest = read_map_file(path).manifest
    for file in manifest.files if manifest else ():
        shutil.copy(path.parent / file.name, folder)
    return _found(folder, path.stem, path.name)


def _found(folder: Path, kind: str, name: str) -> SoundMap:
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    return SoundMap(kind, read_map_file(folder / name).record, folder, name, files)


def _record(training: bool) -> MapRecord:
    rng = np.random.default_rng(0)
    leaves = rng.integers(0, 1 << _SETTINGS.depth, (_POINTS, 3))
    tables = tuple(
        _table(rng, leaves, plane, level)
        for plane in range(len(AXES))
        for level in _SETTINGS.levels
    )
    mlp = _mlp(rng)
    region = Region(
        index=(0, 0, 0),
        frequencies=rng.normal(size=_SETTINGS.frequencies).astype(np.float32),
        mlp=mlp,
        tables=tables,
        evidence=_evidence(rng, leaves),
        training=_training(mlp, tables) if training else None,
    )
    return MapRecord("fuzzed", 5, _SETTINGS, (region,))


def _table(rng: np.random.Generator, leaves: np.ndarray, plane: int, level: int) -> VertexTable:
    nodes = leaves[:, AXES[plane]] >> (_SETTINGS.depth - level)
    corners = np.concatenate([nodes + (a, b) for a in (0, 1) for b in (0, 1)])
    codes = np.unique(morton.encode(corners))
    features = rng.normal(size=(len(codes), _SETTINGS.feature_size)).astype(np.float16)
    return VertexTable(plane, level, codes, features)


def _mlp(rng: np.random.Generator) -> Mlp:
    sizes = (_SETTINGS.input_size, _SETTINGS.hidden, _SETTINGS.hidden, 1)
    pairs = list(zip(sizes[:-1], sizes[1:], strict=True))
    return Mlp(
        tuple(rng.normal(size=pair).astype(np.float32) for pair in pairs),
        tuple(rng.normal(size=b).astype(np.float32) for _, b in pairs),
    )


def _evidence(rng: np.random.Generator, leaves: np.ndarray) -> Evidence:
    codes = np.unique(morton.encode(leaves // BLOCK_VOXELS))
    masks = rng.integers(0, 256, (2, len(codes), BLOCK_BYTES)).astype(np.uint8)
    return Evidence(codes, masks[0], masks[1])


def _with_levels(record: MapRecord) -> MapRecord:
    (region,) = record.regions
    counts = surface_counts(region.evidence.surface)
    levels = np.resize(np.arange(MAX_LEVEL + 1, dtype=np.uint8), int(counts.sum()))
    seen_s = np.where(counts > 0, 1_700_000_000 + np.arange(len(counts)), 0)
    evidence = dataclasses.replace(region.evidence, levels=levels, seen_s=seen_s)
    return dataclasses.replace(record, regions=(dataclasses.replace(region, evidence=evidence),))


def _training(mlp: Mlp, tables: tuple[VertexTable, ...]) -> TrainingState:
    moments = tuple(np.ones(table.features.shape, np.float32) for table in tables)
    arrays = tuple(np.ones_like(array) for array in (*mlp.weights, *mlp.biases))
    return TrainingState(
        table_means=moments,
        table_variances=moments,
        table_steps=tuple(np.arange(len(table.codes), dtype=np.int32) for table in tables),
        mlp_means=arrays,
        mlp_variances=arrays,
        mlp_steps=7,
        sample_points=np.ones((_POINTS, 3), np.float32),
        sample_labels=np.ones(_POINTS, np.float16),
        budget_samples=9,
    )


def _with_integers(record: MapRecord) -> MapRecord:
    (region,) = record.regions
    tables = tuple(
        dataclasses.replace(
            table, features=np.round(table.features / _SCALE).astype(np.int16), scale=_SCALE
        )
        for table in region.tables
    )
    return dataclasses.replace(record, regions=(dataclasses.replace(region, tables=tables),))
