"""Rows of arrays in memory, for what kernels cannot say in Python."""

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

# The stub has it as if callers passed the typing context, which they do not.
kernel_code = cast("Callable[[Callable[..., Any]], Callable[..., Any]]", intrinsic)

_INT32 = ir.IntType(32)


def address_of(
    context: Any,
    builder: Any,
    array: tuple[Any, Any],
    row: tuple[Any, Any],
    column: tuple[Any, Any] | None = None,
) -> Any:
    """Address of ``array[row, column]``; every argument is a (type, value) pair."""
    kind, value = array
    data = context.make_array(kind)(context, builder, value)
    indices = [context.cast(builder, row[1], row[0], types.intp)]
    if column is None:
        indices.append(context.get_constant(types.intp, 0))
    else:
        indices.append(context.cast(builder, column[1], column[0], types.intp))
    return cgutils.get_item_pointer(context, builder, kind, data, indices, wraparound=False)


@kernel_code
def prefetch_row(_: Any, table: Any, row: Any) -> Any:
    """Ask for ``table[row]`` to be brought into the cache."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = list(zip(signature.args, args, strict=True))
        bytes_ = ir.IntType(8).as_pointer()
        address = builder.bitcast(address_of(context, builder, *pairs), bytes_)
        kind = ir.FunctionType(ir.VoidType(), [bytes_, _INT32, _INT32, _INT32])
        call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        # To read, for all cache levels, data.
        builder.call(call, [address, *(ir.Constant(_INT32, flag) for flag in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(table, row), generate
