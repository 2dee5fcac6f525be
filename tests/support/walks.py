"""Which files an operation passes through: a measure of how straight the ways in the code are.

Run as ``PYTHONPATH=tests:. python -m support.walks``. A real service and a real client run in
this process. While an operation goes on, every function of the project that is called is recorded,
in whatever thread; compiled code is followed by the names that its source uses.
"""

import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from support.servers import service_and_client, sphere
from triquad_client import Client
from triquad_server import server_status
from triquad_tools.recordings.publishing import wait_until_settled

_NEVER_S = 1e6
"""The period of the heartbeat, which does work of its own and wakes the mapper in the midst."""

_POINTS = np.random.default_rng(0).uniform(-3.0, 3.0, (1000, 3))


class Recorder:
    """A profile function that records the functions of the project which are called."""

    def __init__(self) -> None:
        self._called: dict[CodeType, dict[str, Any]] | None = None

    def __call__(self, frame: FrameType, _event: str, _argument: object) -> None:
        called = self._called
        if called is None:
            return
        # The caller too: the loop of a thread was called long ago.
        for passed in (frame, frame.f_back):
            if passed is not None and _is_ours(passed.f_code):
                called[passed.f_code] = passed.f_globals

    @contextmanager
    def recording(self) -> Iterator[set[str]]:
        """The files that are passed through while the context is open; complete at its end."""
        files: set[str] = set()
        called = self._called = {}
        try:
            yield files
        finally:
            self._called = None
            for code, names in list(called.items()):
                files.add(_file(code))
                files.update(_compiled_files(code, names, set()))


def files_by_operation() -> dict[str, set[str]]:
    """The files that each operation passes through."""
    recorder = Recorder()
    server_status.STATUS_PERIOD_S = _NEVER_S
    threading.setprofile(recorder)
    sys.setprofile(recorder)
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            service_and_client(store=Path(folder)) as client,
            client.watch_mesh() as watch,
        ):
            updates = iter(watch)
            _scan(client)
            found = {}
            operations: dict[str, Callable[[], object]] = {
                "scan": lambda: _scan(client),
                "query_sdf": lambda: client.query_sdf(_POINTS, gradient=True),
                "query_distance": lambda: client.query_distance(_POINTS),
                "checkpoint": client.checkpoint,
                "mesh update": lambda: next(updates),
            }
            for name, operation in operations.items():
                with recorder.recording() as found[name]:
                    operation()
                wait_until_settled(client)
            return found
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def _scan(client: Client) -> None:
    client.publish_scan(sphere(), np.eye(4))
    client.flush()


def _is_ours(code: CodeType) -> bool:
    return "/triquad_" in code.co_filename


def _file(code: CodeType) -> str:
    return "triquad_" + code.co_filename.split("/triquad_", 1)[1]


def _compiled_files(code: CodeType, names: dict[str, Any], seen: set[CodeType]) -> Iterator[str]:
    """The files of the compiled functions that a function uses, directly or not."""
    if code in seen:
        return
    seen.add(code)
    for function in _compiled_functions(code, names):
        yield _file(function.__code__)
        yield from _compiled_files(function.__code__, function.__globals__, seen)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _compiled_files(constant, names, seen)


def _compiled_functions(code: CodeType, names: dict[str, Any]) -> Iterator[Any]:
    for name in code.co_names:
        used = names.get(name)
        candidates = [used]
        if isinstance(used, ModuleType) and used.__name__.startswith("triquad_"):
            candidates = [getattr(used, member, None) for member in code.co_names]
        for function in candidates:
            if isinstance(function, Dispatcher) and _is_ours(function.py_func.__code__):
                yield function.py_func


def main() -> None:
    """Print the files of each operation."""
    warnings.simplefilter("ignore")
    for name, files in files_by_operation().items():
        print(f"{name}: {len(files)} files")
        for file in sorted(files):
            print(f"    {file}")


if __name__ == "__main__":
    main()
