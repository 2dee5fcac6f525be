"""A map file's metadata record ``triquad``: whether this reader can read the file."""

from triquad_format.errors import DamagedMapFileError, MapFileError, UnsupportedMapFileError
from triquad_format.mapfile.container import BASE_FILES, FORMAT_VERSION
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.map_facts import FRAME_ID, UNITS, MapFacts

KNOWN_FEATURES: frozenset[str] = frozenset({BASE_FILES})
"""The ``required_features`` that this reader understands."""


def one_metadata(found: list[dict[str, str]]) -> dict[str, str]:
    """The metadata record ``triquad``, of which there must be one."""
    if not found:
        raise MapFileError("this is an MCAP file, but not a map: it has no metadata 'triquad'")
    if len(found) > 1:
        raise DamagedMapFileError("the metadata 'triquad' is there more than once")
    return found[0]


def check_readable(metadata: dict[str, str]) -> None:
    """Refuse a file that this reader does not understand.

    Raises:
        UnsupportedMapFileError: it needs a newer reader; the text names what is missing.
        DamagedMapFileError: the metadata does not tell.
    """
    needed = metadata.get("min_reader_version", "")
    # int() alone would also take '+1', ' 1' and digits of other scripts, of any length.
    if not (needed.isascii() and needed.isdigit() and len(needed) < 10):
        raise DamagedMapFileError(f"min_reader_version = {needed!r:.40} is not a number")
    if int(needed) > FORMAT_VERSION:
        raise UnsupportedMapFileError(
            f"it needs a reader of map file version {needed}; this one reads {FORMAT_VERSION}: "
            f"install a newer triquad (written by {metadata.get('producer', 'unknown')!r:.80})",
        )
    if "required_features" not in metadata:
        raise DamagedMapFileError("the metadata 'triquad' does not name its required_features")
    missing = _required(metadata) - KNOWN_FEATURES
    if missing:
        unknown = ", ".join(sorted(missing))
        raise UnsupportedMapFileError(
            f"it requires {unknown:.200}, which this reader does not know: install a newer triquad"
        )


def _required(metadata: dict[str, str]) -> set[str]:
    return {name.strip() for name in metadata["required_features"].split(",")} - {""}


def check_features(metadata: dict[str, str], manifest: Manifest) -> None:
    """Raise :class:`DamagedMapFileError` where a feature is used that is not required."""
    if manifest.files and BASE_FILES not in _required(metadata):
        raise DamagedMapFileError(f"parts lie in other files, but {BASE_FILES} is not required")


def check_agreement(metadata: dict[str, str], facts: MapFacts) -> None:
    """Raise :class:`DamagedMapFileError` unless metadata and parts tell the same."""
    wanted = {
        "map": facts.name,
        "epoch": str(facts.epoch),
        "frame_id": FRAME_ID,
        "units": UNITS,
    }
    for key, value in wanted.items():
        if metadata.get(key) != value:
            raise DamagedMapFileError(
                f"its metadata says {key} = {metadata.get(key)!r:.80}, its parts say {value!r}",
            )
