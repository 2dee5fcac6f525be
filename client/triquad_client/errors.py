"""The errors of the client. Each text says what to do about it.

Callers see a trace that ends at their own line, not a dozen frames below it: :func:`brief`.
"""

from collections.abc import Callable
from functools import wraps
from types import FunctionType
from typing import ParamSpec, TypeVar

from triquad_format.errors import InvalidInputError, TriquadError

NO_NUMBER = (TypeError, ValueError, OverflowError, RuntimeError)
"""The errors of conversions to numbers: Python's integers may be larger than any float, and torch
gives no array of a tensor that requires a gradient."""

ArgumentsP = ParamSpec("ArgumentsP")
ResultT = TypeVar("ResultT")
ClassT = TypeVar("ClassT", bound=type)

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


def brief(function: Callable[ArgumentsP, ResultT]) -> Callable[ArgumentsP, ResultT]:
    """Let the errors of triquad that a function raises begin here, without what caused them."""

    @wraps(function)
    def call(*args: ArgumentsP.args, **kwargs: ArgumentsP.kwargs) -> ResultT:
        try:
            return function(*args, **kwargs)
        except TriquadError as error:
            raise error.with_traceback(None) from None

    return call


def brief_errors(public: ClassT) -> ClassT:
    """Do so for all public methods of a class, also for those that it inherits."""
    for name in dir(public):
        method = getattr(public, name)
        if isinstance(method, FunctionType) and not name.startswith("_"):
            setattr(public, name, brief(method))
    return public
