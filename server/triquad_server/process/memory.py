"""How much memory this process uses."""

import contextlib
import ctypes
import functools
import gc
import importlib
import os
import re
import resource
import sys
from pathlib import Path
from typing import NamedTuple

# Of glibc's mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_LARGE_BYTES = 2 << 20
_ARENAS = 2

_STATM = Path("/proc/self/statm")
_SMAPS = Path("/proc/self/smaps")  # of proc(5)

_COMPILER = "libllvmlite"
_MADV_DONTNEED = 4  # of madvise(2)
_MAPPING = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) .*$", re.MULTILINE)


def resident_bytes() -> int:
    """Resident memory; where the system does not tell, the largest it has been."""
    try:
        return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def give_back_early() -> None:
    """Have memory that is free go back to the system, where its C library is glibc.

    By default it keeps arrays of up to 32 MB for later, for each of some 30 threads apart: a server
    that allocates and frees such arrays all the time would take a quarter more than it uses.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        options = ctypes.CDLL(None).mallopt
        options(_M_ARENA_MAX, _ARENAS)
        options(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        options(_M_TRIM_THRESHOLD, 2 * _LARGE_BYTES)


def give_back_free() -> None:
    """Give memory that is free between what is in use back to the system: some milliseconds.

    Small arrays of many threads lie side by side, and those that stay longest hold the others'
    room: where much was asked of the server, it would keep a fifth of its memory for nothing.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


class _Mapping(NamedTuple):
    """Where a part of a file lies in memory."""

    start: int
    size: int


def give_back_compiler() -> None:
    """Give back what loading compiled kernels read of the compiler's library: some 70 MB.

    Nothing else runs it. Where a kernel is loaded later, the system maps it again.
    """
    with contextlib.suppress(OSError, AttributeError):
        for start, size in _unchanged_mappings(_COMPILER):
            advise = ctypes.CDLL(None).madvise
            advise(ctypes.c_void_p(start), ctypes.c_size_t(size), _MADV_DONTNEED)


@functools.cache
def _unchanged_mappings(library: str) -> tuple[_Mapping, ...]:
    """Where a library's file lies in memory as it is; without the parts that the loader changed."""
    if sys.platform != "linux":
        return ()
    found = []
    text = _SMAPS.read_text()
    headers = list(_MAPPING.finditer(text))
    ends = [header.start() for header in headers[1:]] + [len(text)]
    for header, end in zip(headers, ends, strict=True):
        is_unchanged = re.search(r"^Anonymous: +0 kB$", text[header.end() : end], re.MULTILINE)
        is_read_only = header[0].split()[1] in ("r--p", "r-xp")
        if library in header[0] and is_unchanged and is_read_only:
            start, after = int(header[1], 16), int(header[2], 16)
            found.append(_Mapping(start, after - start))
    return tuple(found)


def put_off_collection() -> None:
    """Collect no garbage until :func:`spare_from_collection`: of what a start makes, most stays."""
    gc.disable()


def spare_from_collection() -> None:
    """Leave all objects that are there now out of every later garbage collection.

    numba alone makes a quarter of a million, which stay: to go through them would stop all threads
    for a tenth of a second.
    """
    gc.collect()
    gc.freeze()
    gc.enable()


def leave_out_blas() -> None:
    """Keep numba from loading the BLAS of scipy, which no kernel calls: 15 MB, and 0.2 s.

    It looks for it once, as the first kernel is loaded; kernels of others could not use it either.
    """
    name = "scipy.linalg"
    if name in sys.modules:
        return
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        del sys.modules[name]
