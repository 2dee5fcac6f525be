"""The bitcode of kernels that were found compiled: kernels that call them are compiled from it.

numba keeps it as LLVM has unpacked it, for as long as the process lives: 14 MB for the kernels of a
server, which will hardly ever compile one.
"""

import zlib
from typing import Any, NamedTuple

from llvmlite import binding
from numba.core.compiler_lock import global_compiler_lock


class _Packed(NamedTuple):
    library: Any  # of a kernel, as numba has it
    bitcode: bytes  # compressed


_unpacked: list[Any] = []  # libraries
_packed: list[_Packed] = []


def add_bitcode(library: Any) -> None:
    """A kernel was found compiled, and this is its library."""
    _unpacked.append(library)


def pack_bitcode() -> None:
    """Keep in a tenth of the memory what was found so far; waits while a kernel is compiled."""
    with global_compiler_lock:
        while _unpacked:
            library = _unpacked.pop()
            module = library._shared_module
            _packed.append(_Packed(library, zlib.compress(module.as_bitcode())))
            library._shared_module = None
            module.close()


def unpack_bitcode() -> None:
    """Have all of it as numba needs it, before a kernel is compiled."""
    with global_compiler_lock:
        while _packed:
            library, bitcode = _packed.pop()
            library._shared_module = binding.parse_bitcode(zlib.decompress(bitcode))
            _unpacked.append(library)
