"""The errors of the server's shell; :mod:`triquad_server.intake.scan` has those of scans."""

from triquad_format.errors import TriquadError


class ServerError(TriquadError):
    """What keeps the server from starting or from doing its work."""


class ListenError(ServerError):
    """The server cannot listen where it was told to."""


class StoreError(ServerError):
    """Checkpoints cannot be read or written."""


class StoreBaseError(StoreError):
    """Files that hold parts of the newest checkpoint are damaged: a complete one is due."""


class MapperStoppedError(ServerError):
    """The mapper thread has ended and takes no more commands."""
