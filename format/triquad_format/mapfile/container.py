"""What a map file is as a container: versions, names, encodings and limits."""

from triquad_format.mapfile.parts.part import MANIFEST, MAP, PREVIEW, REGION_TOPICS

FORMAT_VERSION = 1
MIN_READER_VERSION = 1
METADATA_NAME = "triquad"
MESSAGE_ENCODING = "msgpack"
PREVIEW_ENCODING = "protobuf"
PREVIEW_SCHEMA = "foxglove.SceneUpdate"

ENCODINGS = {
    **dict.fromkeys((MAP, *REGION_TOPICS), MESSAGE_ENCODING),
    PREVIEW: PREVIEW_ENCODING,
    MANIFEST: MESSAGE_ENCODING,
}
"""How the messages of each topic are encoded; topics in the order of their channels' numbers."""

BASE_FILES = "base-files"
"""The required feature of a file whose parts lie in other files, too."""

MAX_PART_BYTES = 32 * 2**20 - 65_536

MAX_MAP_BYTES = 4 * 2**30
"""Limit on the size of a map file, and on its chunks' decompressed size together."""
