"""The errors that all of triquad shares. Each carries the offending value in its text."""

from triquad_format.printable import printable_lines

ERROR_CODES = {
    "bad_request": "the request is malformed or out of range",
    "bad_version": "the request is of another protocol version",
    "too_large": "the request exceeds a limit of the server; split it",
    "epoch_gone": "the epoch is not kept, or not known what changed since; ask the newest",
    "chunk_gone": "the map file asked for is no longer kept; ask for its info again",
    "starting": "the server is not ready yet; the text says what it does",
    "under_way": "the server is at it; ask again with the same ticket",
    "timeout": "the server could not finish in the time that the request allows",
    "busy": "too many requests are waiting, or the server stops or is short of memory",
    "store": "what is needed could not be written, or is not kept; the map stays as it is",
    "internal": "an error inside the server; its log has the details",
}
"""The reasons to refuse a request, in :class:`triquad_format.wire.messages.ErrorReply`."""


class TriquadError(Exception):
    """Base of all errors of triquad.

    A value in its text may come from a file or from the network: it cannot steer the terminal, or
    the log, in which the text is shown.
    """

    def __str__(self) -> str:
        """Return the text, control characters in it as escapes."""
        return printable_lines(super().__str__())


class RefusedError(TriquadError):
    """A request that is not answered.

    ``code`` is one of :data:`ERROR_CODES`, or one that a newer server added; ``message`` names the
    offending value.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


class InvalidInputError(TriquadError, ValueError):
    """An argument that cannot be used; nothing was sent."""


class FormatError(TriquadError):
    """Bytes or values that are not what the triquad formats allow."""


class WireError(FormatError):
    """A wire message that cannot be decoded, or a value that cannot be encoded."""


class ProtocolVersionError(WireError):
    """A wire message of another protocol version."""


class MapFileError(FormatError):
    """A map file that cannot be read."""


class DamagedMapFileError(MapFileError):
    """A map file whose bytes are incomplete or fail a check."""


class UnsupportedMapFileError(MapFileError):
    """A valid map file that needs a newer reader; the text names what is missing."""


class TooLargeMapFileError(MapFileError):
    """A map file above the limit given for its size, or above the memory there is."""


class SettingsError(FormatError):
    """A setting that is unknown or out of range."""


class NoCompiledCodeError(TriquadError):
    """Compiled code answers for maps, and numba, which compiles it, cannot be imported."""
