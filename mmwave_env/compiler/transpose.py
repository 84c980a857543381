"""Transpositions between tables and blocks of SIMD lanes.

In a table, the numbers of one environment are contiguous. In a block (rows, 8), an environment is a
column. Compiled code moves 8 x 8 numbers at a time and transposes them in registers, because moving
them one by one would take as long as an epoch of an EKF. The environments of a block may be
anywhere in a table, so functions receive an address for each environment.
"""

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload, register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.numerics.numbers import Array, Index

_INTEGER = ir.IntType(64)
_DOUBLE = ir.DoubleType()
_SINGLE = ir.FloatType()
_VECTOR = ir.VectorType(_DOUBLE, WIDTH)
_BYTES = {_DOUBLE: 8, _SINGLE: 4}


@register_jitable  # type: ignore[untyped-decorator]
def address(table, i, j):  # type: ignore[no-untyped-def]
    """Return the address of the numbers (k,) of ``table[i, j]``, which must be contiguous."""
    return table.ctypes.data + i * table.strides[0] + j * table.strides[1]


def gather(block: Array, sources: Index, count: int) -> None:
    """Fill the first ``count`` rows of a block (size, 8).

    ``sources`` (8,) has the address of each lane's numbers, which are in double precision.
    """
    for lane, source in enumerate(sources.tolist()):
        block[:count, lane] = _numbers(source, count, ctypes.c_double)


def scatter(block: Array, rows: Index, targets: Index) -> None:
    """Write rows (k,) of a block (size, 8) to memory, each lane to its own address.

    ``targets`` (8,) has an address for each lane: memory for k numbers in double precision.
    """
    for lane, target in enumerate(targets.tolist()):
        _numbers(target, len(rows), ctypes.c_double)[:] = block[rows, lane]


def scatter_single(block: Array, rows: Index, targets: Index) -> None:
    """Write rows of a block as :func:`scatter` does, in single precision."""
    for lane, target in enumerate(targets.tolist()):
        _numbers(target, len(rows), ctypes.c_float)[:] = block[rows, lane]


def _numbers(address: int, count: int, kind: Any) -> NDArray[Any]:
    return np.ctypeslib.as_array((kind * count).from_address(address))


@overload(gather)  # type: ignore[untyped-decorator]
def _compiled_gather(block, sources, count):  # type: ignore[no-untyped-def]
    def compiled(block, sources, count):  # type: ignore[no-untyped-def]
        if count < WIDTH:
            for lane in range(WIDTH):
                for i in range(count):
                    block[i, lane] = number_at(sources[lane] + 8 * i)
            return
        for first in range(0, count, WIDTH):  # tiles of 8 rows; the last two may overlap
            _turn_in(block.ctypes.data, sources.ctypes.data, min(first, count - WIDTH))

    return compiled


def _compiled_scatter(kind: ir.Type) -> Callable[..., Any]:
    size = _BYTES[kind]
    put = _put(kind)
    turn_out = _turn_out(kind)

    def choose(block, rows, targets):  # type: ignore[no-untyped-def]
        def compiled(block, rows, targets):  # type: ignore[no-untyped-def]
            count = len(rows)
            if count < WIDTH:
                for lane in range(WIDTH):
                    for i in range(count):
                        put(targets[lane] + size * i, block[rows[i], lane])
                return
            for tile in range(0, count, WIDTH):
                first = min(tile, count - WIDTH)
                turn_out(block.ctypes.data, rows.ctypes.data, targets.ctypes.data, first)

        # Compiled code is found by its name, so each precision needs a name of its own.
        compiled.__qualname__ += f".{kind}"
        return compiled

    return choose


@intrinsic  # type: ignore[untyped-decorator]
def number_at(_, address):  # type: ignore[no-untyped-def]
    """Return the number in double precision at an address; only compiled code can call this."""

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load(_pointer(builder, arguments[0], _DOUBLE))

    return types.float64(address), build


def _put(kind: ir.Type) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def put(_, address, value):  # type: ignore[no-untyped-def]
        def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            value = _as(kind, builder, arguments[1])
            builder.store(value, _pointer(builder, arguments[0], kind))
            return context.get_dummy_value()

        return types.void(address, types.float64), build

    return put


@intrinsic  # type: ignore[untyped-decorator]
def _turn_in(_, block, sources, first):  # type: ignore[no-untyped-def]
    """Load numbers ``first`` to ``first`` + 7 of each source into the same rows of the block."""

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        block, sources, first = arguments
        offset = builder.mul(first, _INTEGER(8))
        places = [builder.add(_entry(builder, sources, lane), offset) for lane in range(WIDTH)]
        tile = [builder.load(_pointer(builder, place, _VECTOR), align=8) for place in places]
        row = builder.add(block, builder.mul(first, _INTEGER(8 * WIDTH)))
        for i, numbers in enumerate(_turned(builder, tile)):
            place = builder.add(row, _INTEGER(8 * WIDTH * i))
            builder.store(numbers, _pointer(builder, place, _VECTOR), align=8)
        return context.get_dummy_value()

    return types.void(block, sources, first), build


def _turn_out(kind: ir.Type) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def turn_out(_, block, rows, targets, first):  # type: ignore[no-untyped-def]
        """Store ``rows[first:first + 8]`` as numbers ``first`` to ``first`` + 7 of each target."""

        def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            block, rows, targets, first = arguments
            size = _BYTES[kind]
            listed = builder.add(rows, builder.mul(first, _INTEGER(8)))
            numbers = [_entry(builder, listed, i) for i in range(WIDTH)]
            places = [builder.add(block, builder.mul(n, _INTEGER(8 * WIDTH))) for n in numbers]
            tile = [builder.load(_pointer(builder, place, _VECTOR), align=8) for place in places]
            offset = builder.mul(first, _INTEGER(size))
            narrow = ir.VectorType(kind, WIDTH)
            for lane, numbers in enumerate(_turned(builder, tile)):
                place = builder.add(_entry(builder, targets, lane), offset)
                target = _pointer(builder, place, narrow)
                builder.store(_as(narrow, builder, numbers), target, align=size)
            return context.get_dummy_value()

        return types.void(block, rows, targets, first), build

    return turn_out


def _turned(builder: Any, tile: list[Any]) -> list[Any]:
    """Transpose eight vectors: swap halves, then quarters, then eighths across the diagonal."""
    tile = list(tile)
    distance = WIDTH // 2
    while distance:
        for i in (i for i in range(WIDTH) if not i & distance):
            a = tile[i]
            b = tile[i + distance]
            low = [j if not j & distance else WIDTH + j - distance for j in range(WIDTH)]
            high = [j + distance if not j & distance else WIDTH + j for j in range(WIDTH)]
            for at, order in ((i, low), (i + distance, high)):
                chosen = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order)
                tile[at] = builder.shuffle_vector(a, b, chosen)
        distance //= 2
    return tile


def _entry(builder: Any, address: Any, i: int) -> Any:
    """Load the i-th integer of the array at an address."""
    return builder.load(_pointer(builder, builder.add(address, _INTEGER(8 * i)), _INTEGER))


def _pointer(builder: Any, address: Any, kind: ir.Type) -> Any:
    return builder.inttoptr(address, kind.as_pointer())


def _as(kind: ir.Type, builder: Any, value: Any) -> Any:
    return value if value.type == kind else builder.fptrunc(value, kind)


overload(scatter)(_compiled_scatter(_DOUBLE))
overload(scatter_single)(_compiled_scatter(_SINGLE))
