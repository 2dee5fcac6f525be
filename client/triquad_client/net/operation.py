"""Operations: methods that are written once as a call, and that each class runs in its own way."""

import functools
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, get_args, overload

from triquad_client.net.call import Call, ResultT

OwnerT = TypeVar("OwnerT")
ArgumentsP = ParamSpec("ArgumentsP")


class Blocking(ABC):
    """A class whose operations return once they are done."""

    @abstractmethod
    def _run(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""


class Awaited(ABC):
    """A class whose operations are coroutines."""

    @abstractmethod
    async def _run(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""


class operation(Generic[OwnerT, ArgumentsP, ResultT]):  # noqa: N801 - used as a decorator
    """Makes a method that returns a :data:`Call` one that runs it.

    On a :class:`Blocking` object the method returns the call's result, on an :class:`Awaited` one a
    coroutine of it: one text, with its documentation, serves both, and type checkers, editors and
    ``help()`` know which of the two it is.
    """

    def __init__(self, method: Callable[Concatenate[OwnerT, ArgumentsP], Call[ResultT]]) -> None:
        def blocking(self: Any, *args: ArgumentsP.args, **kwargs: ArgumentsP.kwargs) -> ResultT:
            result: ResultT = self._run(method(self, *args, **kwargs))
            return result

        async def awaited(
            self: Any, *args: ArgumentsP.args, **kwargs: ArgumentsP.kwargs
        ) -> ResultT:
            result: ResultT = await self._run(method(self, *args, **kwargs))
            return result

        self._blocking = _described(blocking, method)
        self._awaited = _described(awaited, method)
        self.__doc__ = method.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> Callable[..., Any]: ...

    @overload
    def __get__(self, instance: Blocking, owner: type) -> Callable[ArgumentsP, ResultT]: ...

    @overload
    def __get__(
        self, instance: Awaited, owner: type
    ) -> Callable[ArgumentsP, Coroutine[Any, Any, ResultT]]: ...

    def __get__(self, instance: object, owner: type) -> Callable[..., Any]:
        """Return the method for objects of class ``owner``, bound to ``instance`` if given."""
        method = self._awaited if issubclass(owner, Awaited) else self._blocking
        return method if instance is None else MethodType(method, instance)


def _described(function: Callable[..., Any], method: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``function`` with the name, documentation and signature of ``method``."""
    signature = inspect.signature(method)
    *_, result = get_args(signature.return_annotation)  # Call[result] is a generator's alias
    described = functools.update_wrapper(function, method)
    described.__signature__ = signature.replace(return_annotation=result)  # type: ignore[attr-defined]
    return described
