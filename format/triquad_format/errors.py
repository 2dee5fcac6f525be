"""The errors of the format package. Each carries the offending value in its text."""


class FormatError(Exception):
    """Bytes or values that are not what the triquad formats allow."""


class WireError(FormatError):
    """A wire message that cannot be decoded, or a value that cannot be encoded."""


class ProtocolVersionError(WireError):
    """A wire message of another protocol version."""


class MapFileError(FormatError):
    """A map file that cannot be read."""


class DamagedMapFileError(MapFileError):
    """A map file whose bytes are incomplete or fail a check."""


class NoIndexError(MapFileError):
    """A map file that can only be read as a whole: another tool rewrote it."""


class UnsupportedMapFileError(MapFileError):
    """A sound map file that needs a newer reader; the text names what is missing."""


class TooLargeMapFileError(MapFileError):
    """A map file above the limit given for its size, or above the memory there is."""


class SettingsError(FormatError):
    """A setting that is unknown or out of range."""
