"""Writing a map as a smaller map file."""

from dataclasses import dataclass
from pathlib import Path

from triquad_format.mapfile.writer import Previews, write_map
from triquad_format.records.region import MapRecord

from triquad_tools.console.lines import print_remark
from triquad_tools.mapfiles.quantise import dequantised, quantise
from triquad_tools.mapfiles.source import SourceMap

DTYPES = {"fp16": "<f2", "fp32": "<f4"}
INTEGERS = "int8"
"""Features as integers, most of which take one byte."""

INTEGER_ERROR_M = 0.0015
"""Limit on the change of distances where none is given."""


@dataclass(frozen=True)
class Precision:
    """The storage of features: as floats of ``dtype``, or as integers within an error."""

    dtype: str | None = None  # None: as they are
    max_error_m: float | None = None  # None: no new integers


def chosen_precision(name: str | None, max_error_m: float | None) -> Precision:
    """Return what ``--precision`` and ``--max-error`` ask for."""
    if max_error_m is None and name == INTEGERS:
        max_error_m = INTEGER_ERROR_M
    return Precision(DTYPES.get(name or ""), max_error_m)


def pack_map(source: SourceMap, precision: Precision, path: Path, bytes_before: int) -> str:
    """Write a map file; return its size, and how far distances moved.

    Raises:
        FormatError: integers change distances by more than the limit, or features do not fit the
            dtype.
        OSError: the file cannot be written.
    """
    record, change = source.record, None
    if precision.max_error_m is not None:
        _warn_of_integers(record)
        packed = quantise(record, precision.max_error_m)
        record, change = packed.record, packed.change
    elif precision.dtype is not None:
        record = dequantised(record)
    dtype = precision.dtype or _dtype(record)
    stamp_ns = source.stamp_ns
    previews = _previews(record, stamp_ns)
    info = write_map(record, path, feature_dtype=dtype, stamp_ns=stamp_ns, previews=previews)
    size = f"{info.bytes:,} bytes, {info.bytes / bytes_before:.0%} of {bytes_before:,}"
    if change is None:
        return size
    parameters = sum(region.parameters for region in record.regions)
    return (
        f"{size}\n"
        f"  {info.bytes / max(parameters, 1):.2f} bytes per learnable parameter of {parameters:,}\n"
        f"  99 % of distances moved by less than {_mm(change.surface_m)} at surface, "
        f"{_mm(change.near_m)} near it, {_mm(change.free_m)} in free space; "
        f"the most by {_mm(change.largest_m)}\n"
        "  without training state: it does not fit rounded features"
    )


def _previews(record: MapRecord, stamp_ns: int | None) -> Previews | None:
    """Return what MCAP viewers show; nothing if the libraries for it are not installed."""
    try:
        from triquad_map.preview import previews_of
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        print_remark(
            f"triquad-pack: without a preview for MCAP viewers, as {error.name} is missing: "
            "install triquad[preview]",
        )
        return None
    return previews_of(record, stamp_ns=stamp_ns)


def _warn_of_integers(record: MapRecord) -> None:
    if any(table.scale is not None for region in record.regions for table in region.tables):
        print_remark("triquad-pack: features are integers already: both errors add up")


def _dtype(record: MapRecord) -> str:
    """Return the dtype that keeps all float features as they are."""
    tables = [table for region in record.regions for table in region.tables if len(table.codes)]
    wide = any(table.features.dtype.str == DTYPES["fp32"] for table in tables)
    return DTYPES["fp32" if wide else "fp16"]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2f} mm"
