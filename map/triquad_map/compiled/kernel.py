"""The compilation of kernels, and the folder of their compiled code.

numba finds compiled code on disk as long as the file of a kernel is the same, whatever became of
the functions and constants that the kernel takes from other files. So the folder of the cache is
named by a digest of all files that matter: those that define kernels, and those of
``_CONSTANTS``. A kernel takes functions and constants from these alone; a test checks that.
"""

import hashlib
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite
import numba
import numpy as np
from numba.extending import intrinsic

_ALWAYS = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
"""Options of all kernels: they run without Python's lock, nothing calls them from C, and to divide
by zero gives no exception, for which each division would test (a sixth of the time of a search)."""

_CONSTANTS = (
    "triquad_format/records/",
    "triquad_map/compiled/kernel.py",
    "triquad_map/surface.py",
    "triquad_map/view.py",
)
"""Files of which kernels take constants and records, in addition to those that define kernels."""

_LEAST_FREE_BYTES = 200 << 20
"""The least room on the disk for a new folder; the code of all kernels takes 25 MB."""

_log = logging.getLogger(__name__)

_config: Any = numba.config
_njit: Any = numba.njit  # whose types leave out no_cfunc_wrapper
_kernels: list[Any] = []
_decorating = threading.Lock()

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

# The stub has it as if callers passed the typing context, which they do not.
kernel_code = cast("Callable[[Callable[..., Any]], Callable[..., Any]]", intrinsic)
"""Decorates what generates code for kernels by itself, of what Python cannot say."""


def kernel(**options: Any) -> Callable[[FunctionT], FunctionT]:
    """Compile a function when it is first called, with options of ``numba.njit``.

    It is compiled once for each combination of the arguments' types. Each literal number is a type
    of its own, as is each width of numbers: a kernel that calls a large one says ``np.int64(0)``.
    """

    def compiled(function: FunctionT) -> FunctionT:
        with _decorating:
            before = _config.CACHE_DIR  # which kernels of other programs go by
            _config.CACHE_DIR = str(CODE_FOLDER or before)
            try:
                jit: Any = _njit(cache=CODE_FOLDER is not None, **_ALWAYS, **options)(function)
            finally:
                _config.CACHE_DIR = before
        _kernels.append(jit)
        done: FunctionT = jit
        return done

    return compiled


def inner_kernel(**options: Any) -> Callable[[FunctionT], FunctionT]:
    """Compile a function that kernels alone call: it takes a seventh less time to compile."""
    return kernel(no_cpython_wrapper=True, **options)


def is_first_use() -> bool:
    """Return whether nothing was compiled here yet, or nothing of it could be kept."""
    return CODE_FOLDER is None or not any(CODE_FOLDER.rglob("*.nbc"))


def count_compiled() -> int:
    """Return how many kernels this process had to compile, counted by combination of types."""
    return sum(sum(jit.stats.cache_misses.values()) for jit in _kernels)


def _code_folder() -> Path | None:
    """Return the folder for these sources, without earlier ones; ``None``: nowhere to write."""
    base = _base_folder()
    if base is None:
        return None
    # Installations are apart, since each removes its own earlier folders.
    installation = base / hashlib.sha256(__file__.encode()).hexdigest()[:12]
    folder = installation / _source_digest()
    if not folder.exists() and shutil.disk_usage(base).free < _LEAST_FREE_BYTES:
        _log.warning("%s is nearly full: compiled code is not kept, but made at each start", base)
        return None
    for other in installation.glob("*"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    return folder


def _base_folder() -> Path | None:
    """Return the folder that the user chose for numba, the user's caches, or a temporary one."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    chosen = Path(_config.CACHE_DIR) if _config.CACHE_DIR else caches / "triquad" / "kernels"
    user = getattr(os, "getuid", int)()
    for folder in (chosen, Path(tempfile.gettempdir()) / f"triquad-kernels-{user}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        state = folder.stat()
        # What lies there is run: a temporary folder may be written to by nobody else.
        if folder == chosen or (state.st_uid == user and not state.st_mode & 0o022):
            return folder
    _log.warning("no folder can be written to: set NUMBA_CACHE_DIR, or each start compiles")
    return None


def _source_digest() -> str:
    """Return a digest of the files that kernels are made of, and of the compiler's versions."""
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    for package in ("triquad_map", "triquad_format", "triquad_server", "triquad_tools"):
        spec = find_spec(package)  # without importing it
        for root in map(Path, (spec and spec.submodule_search_locations) or ()):
            for file in sorted(root.rglob("*.py")):
                name, source = file.relative_to(root.parent).as_posix(), file.read_bytes()
                if (
                    name.startswith(_CONSTANTS)
                    or b"@kernel" in source
                    or b"@inner_kernel" in source
                ):
                    digest.update(hashlib.sha256(source).digest())
    return digest.hexdigest()[:24]


CODE_FOLDER = _code_folder()
"""The folder of the compiled code of all kernels; ``None``: it is in memory alone."""
