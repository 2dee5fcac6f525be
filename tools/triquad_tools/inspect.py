"""``triquad-inspect``: what a map file holds, and whether it is sound."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from triquad_tools.errors import ToolError

if TYPE_CHECKING:
    from triquad_format.mapfile import MapFile
    from triquad_format.region import MapRecord, Region

_PROBES = 10_000
_READER_CHECKS = (
    "records and checksums",
    "parts against manifest",
    "versions and metadata",
    "shapes, codes and values",
)


class InspectError(ToolError):
    """A check beyond those of the reader that a map file fails."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 sound, 1 damaged, 2 not readable."""
    arguments = _parser().parse_args(argv)
    from triquad_format.errors import DamagedMapFileError, MapFileError
    from triquad_format.mapfile import read_map_file

    try:
        file = read_map_file(arguments.file)
        report = describe(file)
        if arguments.verify:
            report["checks"] = [*_READER_CHECKS, *_verify(arguments.file, file)]
    except (DamagedMapFileError, InspectError) as error:
        print(f"triquad-inspect: {error}", file=sys.stderr)
        return 1
    except (MapFileError, OSError) as error:
        print(f"triquad-inspect: {error}", file=sys.stderr)
        return 2
    _print(arguments.file, report, arguments.json)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="triquad-inspect",
        description="Show what a map file holds. The file is always read in full and checked.",
        epilog="Exit status: 0 sound, 1 damaged, 2 not readable (missing, or of a newer version).",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="map file")
    parser.add_argument(
        "--verify",
        action="store_true",
        help="check also with the mcap library and by evaluating the field; list the checks",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def describe(file: "MapFile") -> dict[str, Any]:
    """What a map file holds, as plain values."""
    import dataclasses

    record = file.record
    return {
        "bytes": file.size,
        "metadata": file.metadata,
        "map": record.name,
        "epoch": record.epoch,
        "settings": dataclasses.asdict(record.settings),
        "parameters": sum(_parameters(region) for region in record.regions),
        "vertices": sum(len(t.codes) for region in record.regions for t in region.tables),
        "training": any(region.training is not None for region in record.regions),
        "regions": [_describe_region(record, region) for region in record.regions],
        "parts": _describe_parts(file),
    }


def _parameters(region: "Region") -> int:
    """Numbers that were learnt: features, weights and biases."""
    arrays = (*region.mlp.weights, *region.mlp.biases)
    features = sum(table.features.size for table in region.tables)
    return features + sum(array.size for array in arrays)


def _describe_region(record: "MapRecord", region: "Region") -> dict[str, Any]:
    from triquad_format.region import region_centre

    levels = record.settings.levels
    training = region.training
    return {
        "index": list(region.index),
        "centre_m": region_centre(record.settings, region.index).tolist(),
        "parameters": _parameters(region),
        "precision": sorted({table.features.dtype.name for table in region.tables}),
        "vertices": {
            str(level): sum(len(t.codes) for t in region.tables if t.level == level)
            for level in levels
        },
        "evidence_blocks": len(region.evidence.codes),
        "evidence_box_m": _evidence_box(record, region),
        "samples": None if training is None else len(training.sample_points),
        "visits_owed": None if training is None else training.visits_owed,
    }


def _evidence_box(record: "MapRecord", region: "Region") -> list[list[float]] | None:
    """Corners of the box around the region's evidence, to whole blocks, map frame."""
    from triquad_format import morton
    from triquad_format.region import BLOCK_VOXELS, region_centre

    if not len(region.evidence.codes):
        return None
    settings = record.settings
    blocks = morton.decode(region.evidence.codes, 3)
    corner = region_centre(settings, region.index) - settings.region_side_m / 2
    side_m = settings.leaf_m * BLOCK_VOXELS
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    return [(corner + low * side_m).round(6).tolist(), (corner + high * side_m).round(6).tolist()]


def _describe_parts(file: "MapFile") -> dict[str, dict[str, int]]:
    parts: dict[str, dict[str, int]] = {}
    for part in file.parts:
        entry = parts.setdefault(part.topic, {"parts": 0, "bytes": 0, "stored_bytes": 0})
        entry["parts"] += 1
        entry["bytes"] += part.size
        entry["stored_bytes"] += part.stored_size
    return parts


def _verify(path: Path, file: "MapFile") -> list[str]:
    """Checks beyond those of the reader; what they were, once they have passed."""
    return [_verify_with_mcap(path, file), *_verify_field(file.record)]


def _verify_with_mcap(path: Path, file: "MapFile") -> str:
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    except (McapError, ValueError, OSError) as error:
        raise InspectError(f"{path}: the mcap library refuses it: {error}") from error
    parts = sum(topic.startswith("/triquad/") for topic in topics)
    if parts != len(file.parts) + 1:
        raise InspectError(f"{path}: the mcap library finds {parts} parts of {len(file.parts) + 1}")
    return f"mcap library: {len(topics)} messages"


def _verify_field(record: "MapRecord") -> list[str]:
    """The field is finite at block centres of the evidence."""
    import numpy as np
    from triquad_format import morton
    from triquad_format.evaluator import MapEvaluator
    from triquad_format.region import BLOCK_VOXELS, region_centre

    centres = []
    for region in record.regions:
        codes = region.evidence.codes[:: len(region.evidence.codes) // _PROBES + 1]
        leaves = (morton.decode(codes, 3) + 0.5) * BLOCK_VOXELS
        offset = leaves * record.settings.leaf_m - record.settings.region_side_m / 2
        centres.append(offset + region_centre(record.settings, region.index))
    if not centres:
        return []
    points = np.concatenate(centres)
    answer = MapEvaluator(record).query(points)
    if not np.isfinite(answer.sdf).all():
        first = points[int(np.argmin(np.isfinite(answer.sdf)))]
        raise InspectError(f"the field at {first.tolist()} is not finite")
    return [f"field finite at {len(points)} points"]


def _print(path: Path, report: dict[str, Any], as_json: bool) -> None:
    if as_json:
        import json

        print(json.dumps(report, indent=2))
        return
    metadata = report["metadata"]
    print(f"{path}: map {report['map']!r}, epoch {report['epoch']}, {report['bytes']:,} bytes")
    for key in ("format_version", "producer", "created"):
        print(f"  {key.replace('_', ' '):<14}  {metadata.get(key, 'not given')}")
    print(f"  regions         {len(report['regions'])}")
    print(f"  vertices        {report['vertices']:,}")
    print(f"  parameters      {report['parameters']:,}")
    print(f"  training state  {'yes' if report['training'] else 'no'}")
    print("  settings        " + ", ".join(f"{k} {v}" for k, v in report["settings"].items()))
    for region in report["regions"]:
        _print_region(region)
    print(f"  {'part':<20} {'count':>6} {'bytes':>14} {'in the file':>14}")
    for topic, part in report["parts"].items():
        print(f"  {topic:<20} {part['parts']:>6} {part['bytes']:>14,} {part['stored_bytes']:>14,}")
    for check in report.get("checks", ()):
        print(f"  ok: {check}")


def _print_region(region: dict[str, Any]) -> None:
    levels = ", ".join(f"level {level}: {count:,}" for level, count in region["vertices"].items())
    print(f"  region {tuple(region['index'])} at {region['centre_m']} m")
    print(f"    vertices ({', '.join(region['precision'])})  {levels}")
    print(f"    evidence  {region['evidence_blocks']:,} blocks in {region['evidence_box_m']} m")
    if region["samples"] is not None:
        print(f"    training  {region['samples']:,} samples, {region['visits_owed']:,} visits owed")


if __name__ == "__main__":
    sys.exit(main())
