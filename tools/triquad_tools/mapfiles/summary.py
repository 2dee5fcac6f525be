"""The content of a map file, in figures."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import NoCompiledCodeError
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.reader import MapFile
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import (
    MapProgress,
    MapRecord,
    Region,
    owned_evidence,
    surface_counts,
)
from triquad_format.records.replay_rays import are_held_out
from triquad_format.wire.status_messages import FieldFit
from triquad_map.field_fit import PlaceFits, in_cube, map_fit
from triquad_map.opening import open_view

from triquad_tools.console.amounts import within
from triquad_tools.console.report import Row, print_columns, print_rows


@dataclass(frozen=True)
class TopicSummary:
    """The parts of one topic, without the manifest."""

    parts: int
    bytes: int  # of these, unpacked
    stored_bytes: int  # that these take where they are stored


@dataclass(frozen=True)
class RegionSummary:
    """One region. What no other region answers for counts as its volume."""

    index: tuple[int, ...]  # [3]
    centre_m: tuple[float, ...]  # [3] map frame
    parameters: int  # numbers that were learnt: features, weights and biases
    precision: str  # dtypes of the features
    vertices: int
    evidence_box_m: tuple[tuple[float, ...], ...] | None  # two corners, to whole blocks
    surface_m3: float  # voxels in which rays ended
    free_m3: float  # voxels through which rays only passed


@dataclass(frozen=True)
class MapSummary:
    """A map file."""

    bytes: int
    metadata: dict[str, str]
    map: str
    epoch: int
    settings: FieldSettings
    origin_m: tuple[float, ...]  # [3] map frame: from where the map itself counts
    vertices: int
    parameters: int
    surface_m3: float
    free_m3: float
    progress: MapProgress
    training: bool
    learnt_percent: int | None  # of what the scans can teach; None: there is no training state
    fit: FieldFit | None  # to the rays that are held out; None: it holds none
    regions: tuple[RegionSummary, ...]
    parts: dict[str, TopicSummary]


def summarise(file: MapFile) -> MapSummary:
    """Return the figures of a map file."""
    record = file.record
    regions = tuple(_summarise_region(record, region) for region in record.regions)
    by_topic: dict[str, list[Entry]] = {}
    for entry in file.manifest.entries:
        by_topic.setdefault(entry.key.topic, []).append(entry)
    return MapSummary(
        bytes=file.size,
        metadata=file.metadata,
        map=record.name,
        epoch=record.epoch,
        settings=record.settings,
        origin_m=record.origin_m,
        vertices=sum(region.vertices for region in regions),
        parameters=sum(region.parameters for region in regions),
        surface_m3=sum(region.surface_m3 for region in regions),
        free_m3=sum(region.free_m3 for region in regions),
        progress=record.progress,
        training=record.learnt_percent is not None,
        learnt_percent=record.learnt_percent,
        fit=_fit(record),
        regions=regions,
        parts={
            topic: TopicSummary(len(own), sum(e.size for e in own), sum(e.stored for e in own))
            for topic, own in by_topic.items()
        },
    )


def print_summary(name: str, summary: MapSummary) -> None:
    """Print the figures of the file ``name``."""
    title = f"{name}: map {summary.map!r}, epoch {summary.epoch}, {summary.bytes:,} bytes"
    print_rows(title, list(_facts(summary)), align="left")
    for region in summary.regions:
        box = ""
        if region.evidence_box_m is not None:
            box = " in {} to {} m".format(*map(list, region.evidence_box_m))
        facts = [
            Row("vertices", f"{region.vertices:,} ({region.precision})"),
            Row("evidence", f"{_evidence(region)}{box}"),
        ]
        title = f"region {region.index} at {list(region.centre_m)} m"
        print_rows(title, facts, align="left")
    parts = summary.parts.items()
    rows = [(topic, f"{p.parts:,}", f"{p.bytes:,}", f"{p.stored_bytes:,}") for topic, p in parts]
    print_columns(("part", "count", "bytes", "bytes stored"), rows)


def _facts(summary: MapSummary) -> Iterator[Row]:
    for key in ("format_version", "producer", "created"):
        yield Row(key.replace("_", " "), summary.metadata.get(key, "not given"))
    if any(summary.origin_m):
        yield Row("origin", "{:.12g} {:.12g} {:.12g} m".format(*summary.origin_m))
    yield Row("regions", str(len(summary.regions)))
    yield Row("vertices", f"{summary.vertices:,}")
    yield Row("parameters", f"{summary.parameters:,}")
    yield Row("evidence", _evidence(summary))
    done = summary.progress
    made = f"{done.scans_taken:,} scans, {done.samples_trained:,} training samples"
    yield Row("made of", made)
    yield Row("training state", _training(summary.learnt_percent))
    fit, missing = summary.fit, "rays among it" if summary.training else "training state"
    judged = f"none to judge the map by, as there is no {missing}"
    if fit is not None:
        judged = f"within {within(fit.median_m, fit.upper_m)}, of {fit.rays:,} rays"
    yield Row("held-out rays", judged)
    settings = vars(summary.settings).items()
    yield Row("settings", ", ".join(f"{name} {value}" for name, value in settings))


def _training(learnt_percent: int | None) -> str:
    if learnt_percent is None:
        return "no"
    if learnt_percent == 100:
        return "yes, nothing is left to learn"
    return f"yes, training has not ended: {learnt_percent} % is learnt of what there is to learn"


def _evidence(summary: MapSummary | RegionSummary) -> str:
    return f"{summary.surface_m3:,.1f} m3 surface, {summary.free_m3:,.1f} m3 free"


def _summarise_region(record: MapRecord, region: Region) -> RegionSummary:
    evidence = owned_evidence(record.settings, region)
    box = None
    if len(codes := region.evidence.codes):
        blocks = morton.decode(codes, 3)
        ends = np.stack([blocks.min(axis=0), blocks.max(axis=0) + 1])
        block_m = record.settings.leaf_m * BLOCK_VOXELS
        box = record.origin + record.settings.region_corner(region.index) + ends * block_m
    voxel_m3 = record.settings.leaf_m**3
    return RegionSummary(
        index=region.index,
        centre_m=_rounded(record.origin + record.settings.region_centre(region.index)),
        parameters=region.parameters,
        precision=", ".join(sorted({table.features.dtype.name for table in region.tables})),
        vertices=sum(len(table.codes) for table in region.tables),
        evidence_box_m=None if box is None else tuple(map(_rounded, box)),
        surface_m3=int(surface_counts(evidence.surface).sum()) * voxel_m3,
        free_m3=int(surface_counts(evidence.free & ~evidence.surface).sum()) * voxel_m3,
    )


def _rounded(place: Doubles) -> tuple[float, ...]:
    """Return coordinates without the noise of their last bits."""
    return tuple(place.round(6).tolist())


def _fit(record: MapRecord) -> FieldFit | None:
    """Return how well a map fits rays that it was not trained on, as a server computes it.

    ``None``: it has no held-out rays, which are training state, or numba is missing.
    """
    ends = {number: _held_out_ends(region, record) for number, region in enumerate(record.regions)}
    ends = {number: points for number, points in ends.items() if len(points)}
    if not ends:
        return None
    try:
        view = open_view(record)
    except NoCompiledCodeError:
        return None
    fits = []
    with closing(view):
        for number, points in ends.items():
            region = view.region_views[number]
            sdf = region.field.evaluate(points, gradient=False).sdf
            centre = record.origin + region.centre
            fits.append((centre, PlaceFits.of(points, record.settings, sdf)))
    return map_fit(fits)


def _held_out_ends(region: Region, record: MapRecord) -> Floats:
    """Return where a region's held-out rays end in its cube [N, 3], metres from its centre."""
    if region.training is None:
        return np.zeros((0, 3), np.float32)
    rays = region.training.rays
    ends = rays.ends_m(record.settings)[are_held_out(rays.ends)].astype(np.float32)
    return ends[in_cube(ends, record.settings)]
