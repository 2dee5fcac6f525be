"""Rows of a feature table, as kernels read and write them.

A row of 8 numbers is one vector of the processor. The compiler does not find that out by itself
where a loop over a row reads one array and writes another that might be the same, so vectors are
spelt out here; rows of another length are loops.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from triquad_format.records.arrays import Floats

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.row_access import address_of, kernel_code

_LANES = 8
_VECTOR = ir.VectorType(ir.FloatType(), _LANES)
_INT32 = ir.IntType(32)


def _vector(builder: Any, address: Any) -> Any:
    return builder.bitcast(address, _VECTOR.as_pointer())


def _spread(builder: Any, number: Any) -> Any:
    """A vector of the same number in all lanes."""
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(_INT32, 0))
    lanes = ir.Constant(ir.VectorType(_INT32, _LANES), [0] * _LANES)
    return builder.shuffle_vector(first, undefined, lanes)


def _sum(builder: Any, vector: Any) -> Any:
    """The sum of a vector's numbers."""
    float_ = ir.FloatType()
    call = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(float_, [float_, _VECTOR]), "llvm.vector.reduce.fadd.v8f32"
    )
    return builder.call(call, [ir.Constant(float_, 0.0), vector], fastmath=["fast"])


def _multiply_add(builder: Any, total: Any, factor: Any, vector: Any) -> Any:
    product = builder.fmul(vector, _spread(builder, factor), flags=["fast"])
    return builder.fadd(total, product, flags=["fast"])


@kernel_code
def _add_rows_of_8(
    _: Any, out: Any, point: Any, start: Any, table: Any, rows: Any, weights: Any
) -> Any:
    """``out[point, start:start + 8] += weights @ table[rows]`` for 4 rows and weights."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = list(zip(signature.args, args, strict=True))
        target = _vector(builder, address_of(context, builder, *pairs[:3]))
        total = builder.load(target, align=4)
        for corner in range(4):
            row = builder.extract_value(args[4], corner)
            address = address_of(context, builder, pairs[3], (signature.args[4].dtype, row))
            vector = builder.load(_vector(builder, address), align=4)
            weight = builder.extract_value(args[5], corner)
            total = _multiply_add(builder, total, weight, vector)
        builder.store(total, target, align=4)
        return context.get_dummy_value()

    return types.void(out, point, start, table, rows, weights), generate


@kernel_code
def _add_to_row_of_8(
    _: Any, table: Any, row: Any, weight: Any, values: Any, point: Any, start: Any
) -> Any:
    """``table[row] += weight * values[point, start:start + 8]``."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = list(zip(signature.args, args, strict=True))
        source = _vector(builder, address_of(context, builder, *pairs[3:]))
        target = _vector(builder, address_of(context, builder, *pairs[:2]))
        vector = builder.load(source, align=4)
        total = builder.load(target, align=4)
        builder.store(_multiply_add(builder, total, args[2], vector), target, align=4)
        return context.get_dummy_value()

    return types.void(table, row, weight, values, point, start), generate


@kernel_code
def _slopes_of_8(
    _: Any, values: Any, point: Any, start: Any, table: Any, rows: Any, place: Any
) -> Any:
    """As :func:`row_slopes`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = list(zip(signature.args, args, strict=True))
        source = _vector(builder, address_of(context, builder, *pairs[:3]))
        value = builder.load(source, align=4)
        corners = []
        for corner in range(4):
            row = builder.extract_value(args[4], corner)
            address = address_of(context, builder, pairs[3], (signature.args[4].dtype, row))
            corners.append(builder.load(_vector(builder, address), align=4))
        fast = {"flags": ["fast"]}
        across = builder.fsub(corners[1], corners[0], **fast)
        along = builder.fsub(corners[2], corners[0], **fast)
        twist = builder.fsub(builder.fsub(corners[3], corners[1], **fast), along, **fast)
        slopes = (
            _multiply_add(builder, slope, builder.extract_value(args[5], other), twist)
            for slope, other in ((across, 1), (along, 0))
        )
        sums = [_sum(builder, builder.fmul(slope, value, **fast)) for slope in slopes]
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(types.float32, 2)(values, point, start, table, rows, place), generate


@kernel_code
def _move_row_of_8(
    _: Any,
    gradients: Any,
    values: Any,
    means: Any,
    variances: Any,
    row: Any,
    blends: Any,
    scales: Any,
    epsilon: Any,
) -> Any:
    """As :func:`move_row`; ``blends`` are of mean and variance, and so are ``scales``.

    A training step moves some hundred thousand rows. As a loop that takes 2.5 times as long, since
    the compiler cannot tell the four arrays from each other.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = list(zip(signature.args, args, strict=True))
        addresses = [
            _vector(builder, address_of(context, builder, pair, pairs[4])) for pair in pairs[:4]
        ]
        gradient, value, mean, variance = (builder.load(at, align=4) for at in addresses)
        fast = {"flags": ["fast"]}

        def blended(old: Any, new: Any, which: int) -> Any:
            blend = builder.extract_value(args[5], which)
            return _multiply_add(builder, old, blend, builder.fsub(new, old, **fast))

        mean = blended(mean, gradient, 0)
        variance = blended(variance, builder.fmul(gradient, gradient, **fast), 1)
        scale = _spread(builder, builder.extract_value(args[6], 1))
        root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), "llvm.sqrt.v8f32"
        )
        deviation = builder.call(root, [builder.fmul(variance, scale, **fast)])
        deviation = builder.fadd(deviation, _spread(builder, args[7]), **fast)
        rate = builder.fneg(builder.extract_value(args[6], 0))
        value = _multiply_add(builder, value, rate, builder.fdiv(mean, deviation, **fast))
        results = (ir.Constant(_VECTOR, None), value, mean, variance)
        for address, result in zip(addresses, results, strict=True):
            builder.store(result, address, align=4)
        return context.get_dummy_value()

    return types.void(gradients, values, means, variances, row, blends, scales, epsilon), generate


@kernel(fastmath=True, inline="always")
def add_rows(
    out: Floats,
    point: int,
    start: int,
    table: Floats,
    rows: tuple[int, int, int, int],
    weights: tuple[float, float, float, float],
) -> None:
    """``out[point, start:start + size] += weights @ table[rows]``; ``weights`` are float32."""
    if table.shape[1] == _LANES:
        _add_rows_of_8(out, point, start, table, rows, weights)
    else:
        for corner in range(4):
            for k in range(table.shape[1]):
                out[point, start + k] += weights[corner] * table[rows[corner], k]


@kernel(fastmath=True, inline="always")
def add_to_row(
    table: Floats, row: int, weight: float, values: Floats, point: int, start: int
) -> None:
    """``table[row] += weight * values[point, start:start + size]``; ``weight`` is a float32."""
    if table.shape[1] == _LANES:
        _add_to_row_of_8(table, row, weight, values, point, start)
    else:
        for k in range(table.shape[1]):
            table[row, k] += weight * values[point, start + k]


@kernel(fastmath=True, inline="always")
def row_slopes(
    values: Floats,
    point: int,
    start: int,
    table: Floats,
    rows: tuple[int, int, int, int],
    place: tuple[float, float],
) -> tuple[float, float]:
    """How ``values[point, start:start + size] @ row`` changes across and along a cell.

    The row is interpolated between those of the cell's corners, in the order of
    :class:`triquad_map.compiled.field.encoding.PointBatch`, at a ``place`` in it, float32.
    """
    if table.shape[1] == _LANES:
        across, along = _slopes_of_8(values, point, start, table, rows, place)
    else:
        across, along = np.float32(0), np.float32(0)
        for k in range(table.shape[1]):
            low, high = table[rows[0], k], table[rows[1], k]
            twist = table[rows[3], k] - high - table[rows[2], k] + low
            value = values[point, start + k]
            across += value * (high - low + place[1] * twist)
            along += value * (table[rows[2], k] - low + place[0] * twist)
    return across, along


@kernel(fastmath=True, inline="always")
def move_row(
    gradients: Floats,
    values: Floats,
    means: Floats,
    variances: Floats,
    row: int,
    blends: tuple[float, float],
    scales: tuple[float, float],
    epsilon: float,
) -> None:
    """One step of Adam, as in :mod:`triquad_server.engine.compiled_trainer`; clears the gradient.

    Numbers are float32.

    Args:
        gradients, values, means, variances: tables of the same shape.
        row: which.
        blends: how much of the mean, and of the variance, the new gradient makes up.
        scales: the learning rate times the correction of the mean, and that of the variance.
        epsilon: keeps the division finite.
    """
    if values.shape[1] == _LANES:
        _move_row_of_8(gradients, values, means, variances, row, blends, scales, epsilon)
    else:
        for k in range(values.shape[1]):
            gradient = gradients[row, k]
            gradients[row, k] = 0
            means[row, k] += blends[0] * (gradient - means[row, k])
            variances[row, k] += blends[1] * (gradient * gradient - variances[row, k])
            deviation = np.sqrt(variances[row, k] * scales[1]) + epsilon
            values[row, k] -= scales[0] * means[row, k] / deviation
