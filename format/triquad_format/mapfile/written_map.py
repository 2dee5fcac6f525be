"""A map file that was written."""

from dataclasses import dataclass

from triquad_format.mapfile.manifest import Manifest


@dataclass(frozen=True)
class MapFileInfo:
    """What was written."""

    bytes: int
    sha256: str  # of the whole file, hexadecimal
    epoch: int


@dataclass(frozen=True)
class WrittenMap:
    """A file that was written, and what its manifest lists."""

    info: MapFileInfo
    manifest: Manifest
    manifest_sha256: bytes
