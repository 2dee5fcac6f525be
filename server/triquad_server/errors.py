"""The errors of the server."""

from triquad_format.errors import TriquadError

NO_MEMORY = "the system gives no more memory"
"""The words of the server for that, in its log and to clients."""


class ServerError(TriquadError):
    """An error that keeps the server from starting or from doing its work."""


class ListenError(ServerError):
    """The server cannot listen at the given endpoint."""


class StoreError(ServerError):
    """Checkpoints cannot be read or written."""


class StoreInUseError(StoreError):
    """Another server has the folder of a map."""


class LastCheckpointError(StoreError):
    """The server stops, and what was mapped since its last checkpoint is lost."""


class MapperStoppedError(ServerError):
    """The mapper thread has ended and takes no more commands."""


class ScanRefusedError(TriquadError):
    """A scan that cannot be used; ``reason`` is the short key under which it is counted."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class NoRoomYetError(Exception):
    """A scan that has to wait, such as for room until regions leave memory."""
