"""Writing a map as a smaller map file."""

from pathlib import Path

from triquad_format.mapfile.writer import Previews, write_map
from triquad_format.records.region import MapRecord

from triquad_tools.console.lines import print_remark
from triquad_tools.mapfiles.quantise import FieldChange, quantise
from triquad_tools.mapfiles.source import SourceMap


def pack_map(source: SourceMap, path: Path, *, max_error_m: float | None, bytes_before: int) -> str:
    """Write a map file; return its size, and how far distances moved.

    Args:
        source: the map.
        path: the file to write.
        max_error_m: features as integers within this error; ``None``: as they are.
        bytes_before: to which the size is compared.

    Raises:
        FormatError: integers change distances by more than the limit.
        OSError: the file cannot be written.
    """
    record, change = source.record, None
    if max_error_m is not None:
        if any(table.scale is not None for region in record.regions for table in region.tables):
            print_remark("triquad-pack: features are integers already: both errors add up")
        packed = quantise(record, max_error_m)
        record, change = packed.record, packed.change
    stamp_ns, dtype = source.stamp_ns, _feature_dtype(record)
    previews = _previews(record, stamp_ns)
    info = write_map(record, path, feature_dtype=dtype, stamp_ns=stamp_ns, previews=previews)
    size = f"{info.bytes:,} bytes, {info.bytes / bytes_before:.0%} of {bytes_before:,}"
    return size if change is None else f"{size}\n{_told(change)}"


def _told(change: FieldChange) -> str:
    most, largest = (f"{1e3 * one:.2f} mm" for one in (change.quantile_m, change.largest_m))
    return (
        f"  99 % of distances near surface moved by less than {most}, the most by {largest}\n"
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


def _feature_dtype(record: MapRecord) -> str:
    """Return what keeps all float features as they are."""
    tables = [table for region in record.regions for table in region.tables if len(table.codes)]
    return "<f4" if any(table.features.dtype.str == "<f4" for table in tables) else "<f2"
