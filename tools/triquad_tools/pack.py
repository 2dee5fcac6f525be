"""``triquad-pack``: rewrite a map file, smaller."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from triquad_format.region import MapRecord

_DTYPES = {"fp16": "<f2", "fp32": "<f4"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 the map is damaged or nothing is left of it, 2 otherwise."""
    arguments = _parser().parse_args(argv)
    from triquad_format.errors import DamagedMapFileError, FormatError, MapFileError

    try:
        return _pack(arguments)
    except (MapFileError, OSError) as error:
        print(f"triquad-pack: {error}", file=sys.stderr)
        return 1 if isinstance(error, DamagedMapFileError) else 2
    except FormatError as error:
        print(f"triquad-pack: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="triquad-pack",
        description="Rewrite a map file: of another precision, cropped, without training state.",
    )
    parser.add_argument("input", type=Path, metavar="IN", help="map file to read")
    parser.add_argument("output", type=Path, metavar="OUT", help="map file to write")
    parser.add_argument(
        "--precision", choices=sorted(_DTYPES), help="of the features (default: as in IN)"
    )
    parser.add_argument(
        "--crop",
        type=float,
        nargs=6,
        metavar=("XMIN", "YMIN", "ZMIN", "XMAX", "YMAX", "ZMAX"),
        help="keep what answers in this box need, metres, map frame",
    )
    parser.add_argument(
        "--no-training", action="store_true", help="drop what only further training needs"
    )
    parser.add_argument("--force", action="store_true", help="replace OUT where it exists")
    return parser


def _pack(arguments: argparse.Namespace) -> int:
    from triquad_format.crop import crop_record, without_training
    from triquad_format.mapfile import read_map, write_map

    problem = _refusal(arguments.input, arguments.output, arguments.force)
    if problem:
        print(f"triquad-pack: {problem}", file=sys.stderr)
        return 2
    record = read_map(arguments.input)
    dtype = _DTYPES[arguments.precision] if arguments.precision else _feature_dtype(record)
    if arguments.crop is not None:
        record = crop_record(record, arguments.crop[:3], arguments.crop[3:])
        if not record.regions:
            print("triquad-pack: nothing of the map lies in the box", file=sys.stderr)
            return 1
    if arguments.no_training:
        record = without_training(record)
    info = write_map(record, arguments.output, feature_dtype=dtype)
    before = arguments.input.stat().st_size
    print(f"{arguments.output}: {info.bytes:,} bytes, {info.bytes / before:.0%} of {before:,}")
    return 0


def _refusal(source: Path, target: Path, force: bool) -> str | None:
    """Why ``target`` must not be written, if so."""
    if not target.exists():
        return None
    if source.exists() and target.samefile(source):
        return f"{target} is the input; write to another file"
    return None if force else f"{target} exists; give --force to replace it"


def _feature_dtype(record: "MapRecord") -> str:
    for region in record.regions:
        for table in region.tables:
            return str(table.features.dtype.str)
    return _DTYPES["fp16"]


if __name__ == "__main__":
    sys.exit(main())
