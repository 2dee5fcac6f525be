"""The errors of the server's shell; :mod:`triquad_server.intake.scan` has those of scans."""

from triquad_format.wire.messages import ERROR_CODES


class ServerError(Exception):
    """What keeps the server from starting or from doing its work."""


class ListenError(ServerError):
    """The server cannot listen where it was told to."""


class StoreError(ServerError):
    """Checkpoints cannot be read or written."""


class StoreBaseError(StoreError):
    """Files that hold parts of the newest checkpoint are damaged: a complete one is due."""


class MapperStoppedError(ServerError):
    """The mapper thread has ended and takes no more commands."""


class RequestError(Exception):
    """Why a request is not answered; ``code`` is one of ``messages.ERROR_CODES``."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        if code not in ERROR_CODES:
            raise ValueError(f"{code!r} is not one of {', '.join(ERROR_CODES)}")
        self.code = code
