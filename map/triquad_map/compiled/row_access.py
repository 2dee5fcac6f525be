"""Rows of arrays in memory, for what kernels cannot say in Python."""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from triquad_map.compiled.kernel import kernel_code

_INT32 = ir.IntType(32)


@kernel_code
def prefetch_row(_: Any, table: Any, row: Any) -> Any:
    """Ask for ``table[row]`` to be brought into the cache."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind, row_kind = signature.args
        data = context.make_array(kind)(context, builder, args[0])
        number = context.cast(builder, args[1], row_kind, types.intp)
        indices = [number, context.get_constant(types.intp, 0)]
        row_start = cgutils.get_item_pointer(
            context, builder, kind, data, indices, wraparound=False
        )
        bytes_ = ir.IntType(8).as_pointer()
        address = builder.bitcast(row_start, bytes_)
        kind_of_call = ir.FunctionType(ir.VoidType(), [bytes_, _INT32, _INT32, _INT32])
        call = cgutils.get_or_insert_function(builder.module, kind_of_call, "llvm.prefetch.p0")
        # To read, for all cache levels, data.
        builder.call(call, [address, *(ir.Constant(_INT32, flag) for flag in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(table, row), generate
