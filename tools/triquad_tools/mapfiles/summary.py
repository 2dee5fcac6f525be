"""The content of a map file, in figures."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.parts.part import TRAINING_TOPICS
from triquad_format.mapfile.reader import MapFile
from triquad_format.records.arrays import Bytes, Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MAX_LEVEL, MapRecord, Region
from triquad_format.records.seen_space import evidence_box, owned_evidence
from triquad_map.field_fit import MapFit

from triquad_tools.console.amounts import millimetres, within
from triquad_tools.console.lines import print_line
from triquad_tools.console.report import Row, print_columns, print_rows
from triquad_tools.mapfiles.recorded_fit import recorded_fit


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
    precision: tuple[str, ...]  # dtypes of the features
    scales: tuple[float, ...]  # steps of integer features, from the smallest
    vertices: dict[int, int]  # by level
    evidence_blocks: int
    evidence_box_m: tuple[tuple[float, ...], ...] | None  # two corners, to whole blocks
    surface_m3: float  # voxels in which rays ended
    surface_levels: tuple[int, ...]  # number of such voxels by level
    free_m3: float  # voxels through which rays only passed
    rays: int | None  # for replay; None: no training state
    samples: int | None  # likewise
    budget_samples: int | None


@dataclass(frozen=True)
class MapSummary:
    """A map file."""

    bytes: int
    metadata: dict[str, str]
    map: str
    epoch: int
    settings: FieldSettings
    vertices: int
    parameters: int
    bytes_per_parameter: float | None  # of the file without training state; None: there are none
    surface_m3: float
    free_m3: float
    progress: MapProgress
    training: bool
    fit: MapFit | None  # to the rays that are held out; None: it holds none
    regions: tuple[RegionSummary, ...]
    parts: dict[str, TopicSummary]
    checks: tuple[str, ...] = ()  # that were made beyond reading, and passed


def summarise(file: MapFile) -> MapSummary:
    """Return the figures of a map file."""
    record = file.record
    regions = tuple(_summarise_region(record, region) for region in record.regions)
    parts = _summarise_parts(file)
    parameters = sum(region.parameters for region in regions)
    training_bytes = sum(parts[t].stored_bytes for t in TRAINING_TOPICS if t in parts)
    return MapSummary(
        bytes=file.size,
        metadata=file.metadata,
        map=record.name,
        epoch=record.epoch,
        settings=record.settings,
        vertices=sum(sum(region.vertices.values()) for region in regions),
        parameters=parameters,
        bytes_per_parameter=(file.size - training_bytes) / parameters if parameters else None,
        surface_m3=sum(region.surface_m3 for region in regions),
        free_m3=sum(region.free_m3 for region in regions),
        progress=record.progress,
        training=any(region.training is not None for region in record.regions),
        fit=recorded_fit(record),
        regions=regions,
        parts=parts,
    )


def print_summary(name: str, summary: MapSummary) -> None:
    """Print the figures of the file ``name``."""
    title = f"{name}: map {summary.map!r}, epoch {summary.epoch}, {summary.bytes:,} bytes"
    print_rows(title, list(_facts(summary)), align="left")
    for region in summary.regions:
        title = f"region {region.index} at {list(region.centre_m)} m"
        print_rows(title, list(_region_facts(region)), align="left")
    rows = [
        (topic, f"{p.parts:,}", f"{p.bytes:,}", f"{p.stored_bytes:,}")
        for topic, p in summary.parts.items()
    ]
    print_columns(("part", "count", "bytes", "bytes stored"), rows)
    for check in summary.checks:
        print_line(f"  ok: {check}")


def _facts(summary: MapSummary) -> Iterator[Row]:
    for key in ("format_version", "producer", "created"):
        yield Row(key.replace("_", " "), summary.metadata.get(key, "not given"))
    yield Row("regions", str(len(summary.regions)))
    yield Row("vertices", f"{summary.vertices:,}")
    share = summary.bytes_per_parameter
    each = f", {share:.2f} bytes each" if share else ""
    yield Row("parameters", f"{summary.parameters:,}{each}")
    yield Row("evidence", _evidence(summary))
    done = summary.progress
    made = f"{done.scans_taken:,} scans, {done.samples_trained:,} training samples"
    yield Row("made of", made)
    yield Row("training state", "yes" if summary.training else "no")
    yield from _fit_facts(summary)
    settings = vars(summary.settings).items()
    yield Row("settings", ", ".join(f"{name} {value}" for name, value in settings))


def _fit_facts(summary: MapSummary) -> Iterator[Row]:
    """Yield how well the map fits rays that it was not trained on."""
    fit = summary.fit
    if fit is None:
        missing = "rays among it" if summary.training else "training state"
        yield Row("held-out rays", f"none to judge the map by, as there is no {missing}")
        return
    yield Row("held-out rays", f"within {within(fit.median_m, fit.upper_m)}")
    yield Row("", f"{fit.rays:,} rays in {fit.places:,} places")
    name = "worst places"
    for (x, y, z), median_m in zip(fit.worst.tolist(), fit.worst_median_m.tolist(), strict=True):
        yield Row(name, f"within {millimetres(median_m)} at {x:.1f}, {y:.1f}, {z:.1f} m")
        name = ""


def _region_facts(region: RegionSummary) -> Iterator[Row]:
    levels = ", ".join(f"level {level}: {count:,}" for level, count in region.vertices.items())
    precision = ", ".join(region.precision)
    if region.scales:
        precision = f"integers, in steps of {region.scales[0]:.3g} to {region.scales[-1]:.3g}"
    yield Row("vertices", f"{levels} ({precision})")
    if region.evidence_box_m is not None:
        low, high = map(list, region.evidence_box_m)
        yield Row("evidence", f"{region.evidence_blocks:,} blocks in {low} to {high} m")
        yield Row("", _evidence(region))
    if voxels := sum(region.surface_levels):
        shares = ", ".join(f"{i}: {n / voxels:.0%}" for i, n in enumerate(region.surface_levels))
        yield Row("", f"surface by level of support: {shares}")
    if region.samples is not None:
        left = f"a training budget of {region.budget_samples:,}"
        kept = f"{region.rays:,} rays, {region.samples:,} samples"
        yield Row("training", f"{kept}, {left}")


def _evidence(summary: MapSummary | RegionSummary) -> str:
    return f"{summary.surface_m3:,.1f} m3 surface, {summary.free_m3:,.1f} m3 free"


def _summarise_region(record: MapRecord, region: Region) -> RegionSummary:
    training = region.training
    evidence = owned_evidence(record.settings, region)
    box = evidence_box(record.settings, region)
    voxel_m3 = record.settings.leaf_m**3
    levels = np.bincount(evidence.levels, minlength=MAX_LEVEL + 1)
    return RegionSummary(
        index=region.index,
        centre_m=_rounded(record.settings.region_centre(region.index)),
        parameters=region.parameters,
        precision=tuple(sorted({table.features.dtype.name for table in region.tables})),
        scales=tuple(sorted(table.scale for table in region.tables if table.scale is not None)),
        vertices={
            level: sum(len(table.codes) for table in region.tables if table.level == level)
            for level in record.settings.levels
        },
        evidence_blocks=len(region.evidence.codes),
        evidence_box_m=None if box is None else tuple(map(_rounded, box)),
        surface_m3=_bits(evidence.surface) * voxel_m3,
        surface_levels=tuple(levels.tolist()),
        free_m3=_bits(evidence.free & ~evidence.surface) * voxel_m3,
        rays=None if training is None else len(training.rays),
        samples=None if training is None else len(training.sample_points),
        budget_samples=None if training is None else training.budget_samples,
    )


def _bits(masks: Bytes) -> int:
    return int(np.unpackbits(masks).sum(dtype=np.int64))


def _rounded(place: Doubles) -> tuple[float, ...]:
    """Return coordinates without the noise of their last bits."""
    return tuple(place.round(6).tolist())


def _summarise_parts(file: MapFile) -> dict[str, TopicSummary]:
    """Return the parts by topic."""
    by_topic: dict[str, list[Entry]] = {}
    for entry in file.manifest.entries:
        by_topic.setdefault(entry.key.topic, []).append(entry)
    return {
        topic: TopicSummary(len(own), sum(e.size for e in own), sum(e.stored for e in own))
        for topic, own in by_topic.items()
    }
