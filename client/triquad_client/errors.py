"""The errors of the client. Each text says what to do about it."""

from triquad_format.errors import InvalidInputError, TriquadError

NO_NUMBER = (TypeError, ValueError, OverflowError, RuntimeError)
"""The errors of conversions to numbers: Python's integers may be larger than any float, and torch
gives no array of a tensor that requires a gradient."""

_MAPS_NAMED = 20
_NO_MAPS = "none (is this a router without a triquad server?)"


class InvalidScanError(InvalidInputError):
    """A scan that cannot be published; nothing was sent."""


class ConnectError(TriquadError):
    """No server, or one that does not let us in, at the endpoint."""


class UnknownMapError(TriquadError):
    """No server has a map of this name; ``available`` lists the maps there are."""

    def __init__(self, map_name: str, available: list[str]) -> None:
        there = ", ".join(available[:_MAPS_NAMED]) or _NO_MAPS
        if len(available) > _MAPS_NAMED:
            there += f" and {len(available) - _MAPS_NAMED} more"
        super().__init__(f"no server has a map {map_name!r}; available: {there}")
        self.map_name = map_name
        self.available = available


class NoReplyError(TriquadError):
    """The map is there, but the request got no reply at all."""


class RequestTimeoutError(TriquadError):
    """The reply did not come in time."""


class BadReplyError(TriquadError):
    """A reply that is no answer to the question, or that this release does not understand."""


class EmptierMapError(TriquadError):
    """Another run of the server has a map with far less in it: the older copy stays."""


class ClosedError(TriquadError):
    """The client was closed."""


class DownloadError(TriquadError):
    """A map file or a mesh could not be fetched whole, or is larger than this client takes."""
