"""Errors as callers see them: the trace ends at their own line, not a dozen frames below it."""

from collections.abc import Callable
from functools import wraps
from types import FunctionType
from typing import ParamSpec, TypeVar

from triquad_format.errors import TriquadError

ArgumentsP = ParamSpec("ArgumentsP")
ResultT = TypeVar("ResultT")
ClassT = TypeVar("ClassT", bound=type)


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
