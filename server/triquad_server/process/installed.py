"""Checks for the libraries that the server needs in addition to the base installation."""

import importlib.util

from triquad_server.errors import ServerError

_NEEDED = ("numba", "pydantic")


def require_libraries() -> None:
    """Report what to install, before anything is imported that needs it.

    Raises:
        ServerError: a library is missing.
    """
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise ServerError(f"{', '.join(missing)} is missing: install triquad[server]")
