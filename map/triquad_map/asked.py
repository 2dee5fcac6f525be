"""Parts of an answer that are there where they were asked for."""

from typing import TypeVar

from triquad_format.errors import TriquadError

PartT = TypeVar("PartT")


class NotAskedError(TriquadError, AttributeError):
    """A part of an answer that was not asked for."""


def asked(name: str, part: PartT | None, argument: str) -> PartT:
    """Return the part called ``name``, so that who asked for it need not prove that it is there.

    Raises:
        NotAskedError: it is ``None``, as the query's ``argument`` was left out.
    """
    if part is None:
        raise NotAskedError(f"{name} was not asked for: give the query {argument}=True")
    return part
