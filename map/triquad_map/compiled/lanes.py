"""Instructions that kernels cannot say in Python: eight numbers at once, and prefetching.

The compiler makes vector instructions of long loops, but not of loops over eight numbers, nor does
it find by itself the few of them that are small enough. So here a vector of the processor is a
type of its own: ``+ - * /`` of two of them go lane by lane, and so do the functions below.
"""

import operator
from collections.abc import Callable
from typing import Any, TypeAlias

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import lower_builtin, models, register_model, type_callable

from triquad_map.compiled.kernel import kernel_code

LANES = 8

Lanes: TypeAlias = Any
"""[LANES] numbers in single precision."""

_FLOAT, _INT32, _INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_FAST = ("fast",)


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


_KIND = _LanesType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)  # type: ignore[no-untyped-call]


def _define(operation: Callable[[Any, Any], Any], instruction: str) -> None:
    """Have an operator of two vectors be an instruction."""

    def result(_: Any) -> Callable[[Any, Any], Any]:
        return lambda first, second: _KIND if first == second == _KIND else None

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FAST)

    type_callable(operation)(result)
    lower_builtin(operation, _LanesType, _LanesType)(generate)


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    kind = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, args, fastmath=_FAST if result in (_FLOAT, _VECTOR) else ())


def _address(context: Any, builder: Any, kinds: Any, args: Any) -> Any:
    """Return where the lanes from ``array[place]`` on lie, given the array and the place."""
    array = context.make_array(kinds[0])(context, builder, args[0])
    numbers = cgutils.unpack_tuple(builder, args[1])
    indices = [
        context.cast(builder, number, kind, types.intp)
        for number, kind in zip(numbers, kinds[1], strict=True)
    ]
    element = cgutils.get_item_pointer(context, builder, kinds[0], array, indices, wraparound=False)
    return builder.bitcast(element, _VECTOR.as_pointer())


@kernel_code
def load(_: Any, array: Any, place: Any) -> Any:
    """Return the lanes from ``array[place]`` on; a place has an index for each axis."""

    def generate(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, kind.args, args), align=4)

    return _KIND(array, place), generate


@kernel_code
def store(_: Any, array: Any, place: Any, lanes: Any) -> Any:
    """Put ``lanes`` into ``array[place]`` and what follows."""

    def generate(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, kind.args, args), align=4)
        return context.get_dummy_value()

    return types.void(array, place, lanes), generate


@kernel_code
def fill(_: Any, number: Any) -> Any:
    """Return the same number in all lanes."""

    def generate(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        single = context.cast(builder, args[0], kind.args[0], types.float32)
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(undefined, single, ir.Constant(_INT32, 0))
        lanes = ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES)
        return builder.shuffle_vector(first, undefined, lanes)

    return _KIND(number), generate


@kernel_code
def larger(_: Any, first: Any, second: Any) -> Any:
    """Return the larger number of each lane."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args, flags=_FAST), *args)

    return _KIND(first, second), generate


@kernel_code
def root(_: Any, lanes: Any) -> Any:
    """Return the square roots."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return _call(builder, f"llvm.sqrt.v{LANES}f32", _VECTOR, args)

    return _KIND(lanes), generate


@kernel_code
def whole(_: Any, lanes: Any) -> Any:
    """Return the nearest whole numbers."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return _call(builder, f"llvm.nearbyint.v{LANES}f32", _VECTOR, args)

    return _KIND(lanes), generate


@kernel_code
def least(_: Any, lanes: Any) -> Any:
    """Return the least number of all."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return _call(builder, f"llvm.vector.reduce.fmin.v{LANES}f32", _FLOAT, args)

    return types.float32(lanes), generate


@kernel_code
def total(_: Any, lanes: Any) -> Any:
    """Return the sum of all numbers."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        args = [ir.Constant(_FLOAT, 0.0), *args]
        return _call(builder, f"llvm.vector.reduce.fadd.v{LANES}f32", _FLOAT, args)

    return types.float32(lanes), generate


@kernel_code
def at_most(_: Any, lanes: Any, limit: Any) -> Any:
    """Return the lanes whose numbers are at most those of ``limit``, as bits from lane 0 up."""

    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered("<=", *args), ir.IntType(LANES))
        return builder.zext(bits, _INT64)

    return types.int64(lanes, limit), generate


@kernel_code
def lowest_bit(_: Any, bits: Any) -> Any:
    """Return the number of the lowest bit that is set; there is one."""

    def generate(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        wide = context.cast(builder, args[0], kind.args[0], types.int64)
        return _call(builder, "llvm.cttz.i64", _INT64, [wide, ir.Constant(ir.IntType(1), 1)])

    return types.int64(bits), generate


@kernel_code
def prefetch_row(_: Any, table: Any, row: Any) -> Any:
    """Ask for ``table[row]`` to be brought into the cache."""

    def generate(context: Any, builder: Any, kind: Any, args: Any) -> Any:
        place = cgutils.pack_array(builder, [args[1], ir.Constant(args[1].type, 0)])
        pair = types.UniTuple(kind.args[1], 2)
        address = _address(context, builder, (kind.args[0], pair), (args[0], place))
        # To read, for all cache levels, data.
        flags = [ir.Constant(_INT32, flag) for flag in (0, 3, 1)]
        start = builder.bitcast(address, ir.IntType(8).as_pointer())
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [start, *flags])
        return context.get_dummy_value()

    return types.void(table, row), generate
