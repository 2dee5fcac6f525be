"""How kernels are compiled, and where their compiled code is kept.

numba finds compiled code again as long as the file of a kernel is the same, whatever became of the
functions and constants that the kernel takes from other files. Here the code of a module's kernels
is kept in a folder that is named by a digest of the module and of all that it imports of these
packages, directly or not; folders of earlier digests are removed. Versions of numba and kinds of
processors numba tells apart itself.
"""

import functools
import hashlib
import logging
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding
from numba.core import caching, event
from numba.extending import intrinsic

from triquad_map.compiled.bitcode import add_bitcode, unpack_bitcode

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_OURS = "triquad_"
"""What the names of the packages begin with whose modules count."""

_IMPORT = re.compile(
    rf"^(?:from|import)\s+({_OURS}[\w.]+)(?:\s+import\s+(\([^)]*\)|[^\n]*))?", re.MULTILINE
)
"""An import of a module of these, and the names after it; to parse the files takes 0.2 s."""

COMPILING = "compiling, half a minute or more in all: this is done once for each release"
"""What is told where compiled code is not found."""

_LONGEST_TURN_S = 60.0
"""After so long a process that compiles a kernel counts as one that hangs."""

_LOOK_S = 0.02  # between two looks whether it is done

_ALWAYS = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""Options of all kernels: they run without Python's lock, nothing calls them from C, and to divide
by zero gives no exception, for which each division would look (a sixth of the time of a search)."""

_log = logging.getLogger(__name__)

_numba_config: Any = numba.config
_njit: Any = numba.njit  # whose types leave out no_cfunc_wrapper: nothing here is called from C
_FunctionCache: Any = caching.FunctionCache
_choosing_folder = threading.Lock()

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

# The stub has it as if callers passed the typing context, which they do not.
kernel_code = cast("Callable[[Callable[..., Any]], Callable[..., Any]]", intrinsic)
"""Decorates what generates code for kernels by itself, of what Python cannot say."""


def kernel(**options: Any) -> Callable[[FunctionT], FunctionT]:
    """Compile a function when it is first called; it runs without Python's lock.

    It is compiled once for each combination of the arguments' types. Each literal number is a type
    of its own, as is each width of numbers: a kernel that calls a large one says ``np.int64(0)``.

    Args:
        options: of ``numba.njit``.
    """

    def compiled(function: FunctionT) -> FunctionT:
        with _choosing_folder:
            chosen = _numba_config.CACHE_DIR
            folder = _code_folder(function.__module__, chosen)
            _numba_config.CACHE_DIR = str(folder or chosen)
            try:
                jit: Any = _njit(**_ALWAYS, **options)(function)
                if folder is not None:
                    jit._cache = _KeptCode(function)  # as its enable_caching() does
            finally:
                _numba_config.CACHE_DIR = chosen
        done: FunctionT = jit
        return done

    return compiled


def inner_kernel(**options: Any) -> Callable[[FunctionT], FunctionT]:
    """As :func:`kernel`, for a function that kernels alone call.

    It takes no objects of Python, and a seventh less time to compile.
    """
    return kernel(no_cpython_wrapper=True, **options)


class _KeptCode(_FunctionCache):  # type: ignore[misc]
    """The compiled code of a kernel on disk, without which the kernel works as well.

    Of several processes that come to a kernel at the same time one compiles it; others wait.
    """

    _turn: IO[bytes] | None = None  # by which others know that this process compiles it

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Compiled code, if there is some; what cannot be read is compiled and kept anew."""
        code = self._load(sig, target_context)
        if code is None and self._turn is None:
            # No two wait for each other: a kernel waits for those alone that it calls.
            self._turn = self._begin_turn()
            code = self._load(sig, target_context)
            if code is not None:
                self._end_turn()
        if code is None:
            unpack_bitcode()
        else:
            add_bitcode(code.library)
        return code

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code for other processes, where the disk has room for it."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.warning("%s: its compiled code cannot be kept: %s", self._name, error)
        finally:
            self._end_turn()

    def _begin_turn(self) -> IO[bytes] | None:
        """Wait until no other process compiles the kernel; None: it is compiled all the same."""
        try:
            folder = Path(self.cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            turn = (folder / f"{self._py_func.__qualname__}.lock").open("wb")
        except OSError:
            return None
        ends_s = time.monotonic() + _LONGEST_TURN_S
        while not _is_locked(turn):
            if time.monotonic() > ends_s:
                turn.close()
                return None
            time.sleep(_LOOK_S)
        return turn

    def _end_turn(self) -> None:
        if self._turn is not None:
            self._turn.close()
            self._turn = None

    def _load(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # whatever comes of a file that a power cut left half written
            _log.warning("%s: its compiled code on disk is damaged: %r", self._name, error)
            with suppress(OSError):
                self.flush()
            return None


def _is_locked(file: IO[bytes]) -> bool:
    """Lock a file until it is closed, unless another process has; True where none can."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


class _CompilingIsTold(event.Listener):
    """Tells once that it takes a while, as soon as a kernel is not found compiled."""

    def __init__(self) -> None:
        self._told = False

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        if not self._told and module.startswith(_OURS):
            self._told = True
            _log.warning(COMPILING)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompilingIsTold())


@functools.cache
def compiled_marks(module: str) -> Path | None:
    """A folder for marks of which kernels that ``module`` leads to are compiled; None: nowhere.

    It is another one for other sources, another release of numba, and another processor.
    """
    folder = _code_folder(module, _numba_config.CACHE_DIR)
    if folder is None:
        return None
    processor = f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"
    digest = hashlib.sha256(f"{numba.__version__} {processor}".encode())
    return folder / f"compiled-{digest.hexdigest()[:24]}"


@functools.cache
def _code_folder(module: str, chosen: str) -> Path | None:
    """Where the compiled code of a module is kept; ``None`` where nothing can be written."""
    base = _base_folder(chosen)
    if base is None:
        return None
    place = f"{sys.implementation.cache_tag} {_file_of(module)}"  # installations do not mix
    versions = base / f"{module}-{hashlib.sha256(place.encode()).hexdigest()[:12]}"
    folder = versions / _source_digest(module)
    for other in versions.glob("*"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    return folder


@functools.cache
def _base_folder(chosen: str) -> Path | None:
    """The folder that the user chose for numba, that of the user's caches, or a temporary one."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    folder = Path(chosen) if chosen else caches / "triquad" / "kernels"
    if _can_write(folder):
        return folder
    user = 0 if sys.platform == "win32" else os.getuid()
    shared = Path(tempfile.gettempdir()) / f"triquad-kernels-{user}"
    if not _can_write(shared):
        return None
    # Compiled code that lies there is run: nobody else may be able to write to it.
    state = shared.stat()
    private = state.st_uid == user and not state.st_mode & 0o022
    return shared if private or sys.platform == "win32" else None


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _source_digest(module: str) -> str:
    """A digest of a module and of all modules of these packages that it imports."""
    reached, waiting = {module}, [module]
    while waiting:
        new = _imports(waiting.pop()) - reached
        reached |= new
        waiting.extend(new)
    digest = hashlib.sha256(np.__version__.encode())
    for name in sorted(reached):
        digest.update(name.encode() + hashlib.sha256(_file_of(name).read_bytes()).digest())
    return digest.hexdigest()[:24]


@functools.cache
def _imports(module: str) -> set[str]:
    """The modules of these packages that a module imports itself, at its top level."""
    names: set[str] = set()
    for parent, children in _IMPORT.findall(_file_of(module).read_text(encoding="utf-8")):
        names.add(parent)
        names.update(f"{parent}.{child}" for child in re.findall(r"\w+", children))
    return names & sys.modules.keys()


def _file_of(module: str) -> Path:
    return Path(str(sys.modules[module].__file__))
