"""Lanes: SIMD numbers with one value for each of eight environments.

Arithmetic on :class:`Lanes` emits LLVM ``<8 x double>`` instructions. To compile a function of
numbers, :func:`kernel` calls it once with Lanes; the instructions emitted by this call are the
compiled function, which has no branches. If the function is called with floats, it runs as usual.

Lanes are stored in blocks (rows, 8): an environment is a column. In a table, the numbers of one
environment are contiguous. :func:`gather` and :func:`scatter` copy between tables and blocks: they
transpose 8 x 8 numbers at a time in registers, because moving the numbers one by one would take as
long as an epoch of an EKF. They receive an address for each environment, which may be anywhere.
"""

import ctypes
import math
import operator
from bisect import bisect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload, register_jitable
from numpy.typing import NDArray

from mmwave_env.numerics.numbers import Array, Index, polynomial, where
from mmwave_env.numerics.tape import Tracer, TracerCondition

WIDTH = 8
_WORD = ir.IntType(64)
_DOUBLE = ir.DoubleType()
_SINGLE = ir.FloatType()
_BYTES = {_DOUBLE: 8, _SINGLE: 4}
_VECTOR = ir.VectorType(_DOUBLE, WIDTH)
_BITS = ir.VectorType(_WORD, WIDTH)
_FLAGS = ("contract", "nsz", "arcp")  # not "nnan": comparisons with NaN stay defined

# arctan(q) = q + q^3 p(q^2) for |q| <= tan(pi/8), with a Chebyshev fit p; error below 2e-16.
_ARCTAN = (
    0.022493317041519877,
    -0.04462310184914474,
    0.05729090419200224,
    -0.06648248301435489,
    0.07690901995337751,
    -0.09090842158974809,
    0.11111109221182906,
    -0.14285714257092566,
    0.19999999999809506,
    -0.33333333333332993,
)
_TAN_PI_8 = math.sqrt(2.0) - 1.0
# log((1 + s) / (1 - s)) = 2 s p(s^2) for |s| <= 0.172, where p is from the Taylor series of atanh.
_ATANH = tuple(1.0 / k for k in range(19, 0, -2))
# exp(r) for |r| <= ln(2) / 2: Taylor series, error below 1e-17.
_EXP = tuple(1.0 / math.factorial(k) for k in range(14, -1, -1))
# cos(r) and (sin(r) / r - 1) / r^2 for |r| <= pi / 4: Taylor series in r^2, error below 1e-17.
_COS = tuple((-1) ** (k // 2) / math.factorial(k) for k in range(18, -1, -2))
_SIN = tuple((-1) ** (k // 2) / math.factorial(k) for k in range(17, 1, -2))
# sum: pi / 2
_HALF_PI_HIGH = 1.57079632673412561417
_HALF_PI_LOW = 6.07710050650619224932e-11
_ROUND = 1.5 * 2.0**52  # adding it rounds to an integer, which is in the sum's lowest bits
# sum: ln(2)
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10


class _Value:
    """A value in the function being built, with the builder that emits its instructions."""

    __slots__ = ("builder", "value")

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder = builder
        self.value = value

    def _with(self, instruction: str, other: Any) -> Any:
        """Return the result of an instruction on this and another value; keep this value's type."""
        term = _bits(other) if isinstance(other, int) else other.value
        return type(self)(self.builder, getattr(self.builder, instruction)(self.value, term))


def _integer(instruction: str) -> Any:
    return lambda a, b: a._with(instruction, b)


class Mask(_Value, TracerCondition):
    """A truth value per lane, from a comparison of Lanes; ``&`` and ``|`` combine two masks."""

    __slots__ = ()
    __and__ = _integer("and_")
    __or__ = _integer("or_")

    def select(self, a: Any, b: Any) -> "Lanes":
        """Return ``a`` in the lanes where the mask is true, else ``b``."""
        return Lanes(self.builder, self.builder.select(self.value, _lift(a), _lift(b)))


class Lanes(_Value, Tracer):
    """Eight doubles in one SIMD value of the function being built."""

    __slots__ = ()

    def combine(self, op: str, a: Any, b: Any) -> "Lanes":
        """Compute ``a op b`` per lane."""
        instruction = getattr(self.builder, f"f{op}")
        return Lanes(self.builder, instruction(_lift(a), _lift(b), flags=_FLAGS))

    def compare(self, op: str, other: Any) -> Mask:
        """Return the condition ``self op other`` per lane; it is false if either number is NaN."""
        return Mask(self.builder, self.builder.fcmp_ordered(op, self.value, _lift(other)))

    def __neg__(self) -> "Lanes":
        return Lanes(self.builder, self.builder.fneg(self.value, flags=_FLAGS))

    def __abs__(self) -> "Lanes":
        return self._call("fabs")

    def constant(self, value: float) -> "Lanes":
        """Return lanes with the same value in every lane."""
        return Lanes(self.builder, _lift(value))

    def sqrt(self) -> "Lanes":
        """Return the square root per lane, correctly rounded."""
        return self._call("sqrt")

    def floor(self) -> "Lanes":
        """Return the largest integer that is not above the number, per lane."""
        return self._call("floor")

    def as_word(self) -> "WordLanes":
        """Return the bits of the eight doubles as eight words."""
        return WordLanes(self.builder, self.builder.bitcast(self.value, _BITS))

    def _call(self, name: str) -> "Lanes":
        signature = ir.FunctionType(_VECTOR, [_VECTOR])
        full = f"llvm.{name}.v{WIDTH}f64"
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            self.builder.module, signature, full
        )
        return Lanes(self.builder, self.builder.call(function, [self.value], fastmath=_FLAGS))

    def atan2(self, x: Any) -> "Lanes":
        """Return the angle of (x, self), reduced to pi / 8 for a polynomial; error 2e-16."""
        ax = abs(x)
        ay = abs(self)
        steep = ay > ax
        low = where(steep, ax, ay)
        high = where(steep, ay, ax)
        large = low > _TAN_PI_8 * high
        over = where(large, low + high, high)
        q = where(large, low - high, low) / where(over > 0.0, over, 1.0)  # 0 for (0, 0)
        z = q * q
        angle = q + q * z * polynomial(z, _ARCTAN)
        angle = where(large, angle + math.pi / 4, angle)
        angle = where(steep, math.pi / 2 - angle, angle)
        angle = where(x < 0.0, math.pi - angle, angle)
        return where(self < 0.0, -angle, angle)  # type: ignore[no-any-return]

    def cos_sin(self) -> "tuple[Lanes, Lanes]":
        """Return cosine and sine, if |self| < 1e5: reduced to at most pi / 4, then polynomials."""
        b = self.builder
        rounded: Any = self * (2.0 / math.pi) + _ROUND
        quarters = b.bitcast(rounded.value, _BITS)
        turns = rounded - _ROUND
        r = (self - turns * _HALF_PI_HIGH) - turns * _HALF_PI_LOW
        z = r * r
        cosine = polynomial(z, _COS)
        sine = r + r * z * polynomial(z, _SIN)
        odd = Mask(b, b.trunc(quarters, ir.VectorType(ir.IntType(1), WIDTH)))
        after = b.add(quarters, _bits(1))
        return where(odd, sine, cosine)._negated(after), where(odd, cosine, sine)._negated(quarters)

    def _negated(self, quarters: Any) -> "Lanes":
        """Negate the lanes in which the integer ``quarters`` has its second bit set."""
        b = self.builder
        sign = b.shl(b.and_(quarters, _bits(2)), _bits(62))
        return Lanes(b, b.bitcast(b.xor(b.bitcast(self.value, _BITS), sign), _VECTOR))

    def log(self) -> "Lanes":
        """Return the natural logarithm of finite, positive, normal numbers; NaN for NaN."""
        b = self.builder
        bits = b.bitcast(self.value, _BITS)
        mantissa_bits = b.or_(b.and_(bits, _bits(0xFFFFFFFFFFFFF)), _bits(0x3FF0000000000000))
        m: Any = Lanes(b, b.bitcast(mantissa_bits, _VECTOR))
        e: Any = Lanes(b, b.sitofp(b.sub(b.lshr(bits, _bits(52)), _bits(1023)), _VECTOR))
        high = m > math.sqrt(2.0)
        m = where(high, 0.5 * m, m)
        e = where(high, e + 1.0, e)
        s = (m - 1.0) / (m + 1.0)
        return e * math.log(2.0) + 2.0 * s * polynomial(s * s, _ATANH) + (self - self)  # type: ignore[no-any-return]

    def exp(self) -> "Lanes":
        """Return the exponential of the numbers after limiting them to [-708, 708]."""
        b = self.builder
        x: Any = where(self < -708.0, -708.0, where(self > 708.0, 708.0, self))
        shifted = x * (1.0 / math.log(2.0)) + 1023.5  # positive, so truncation rounds down
        k = b.fptosi(shifted.value, _BITS)
        n = Lanes(b, b.sitofp(k, _VECTOR)) - 1023.0
        r = (x - n * _LN2_HIGH) - n * _LN2_LOW
        power = Lanes(b, b.bitcast(b.shl(k, _bits(52)), _VECTOR))
        return polynomial(r, _EXP) * power  # type: ignore[no-any-return]


class WordLanes(_Value):
    """Eight words of 64 bits (:class:`~mmwave_env.numerics.random.Word`) in one SIMD value."""

    __slots__ = ()
    __add__ = _integer("add")
    __xor__ = _integer("xor")
    __or__ = _integer("or_")
    __lshift__ = _integer("shl")
    __rshift__ = _integer("lshr")

    def scaled(self, factor: float) -> Any:
        """Return the integers, which must be below 2^63, times a factor."""
        return Lanes(self.builder, self.builder.sitofp(self.value, _VECTOR)) * factor

    def as_number(self) -> Lanes:
        """Return the floats that have these bits."""
        return Lanes(self.builder, self.builder.bitcast(self.value, _VECTOR))


def _bits(value: int) -> Any:
    return ir.Constant(_BITS, [value] * WIDTH)


def _lift(a: Any) -> Any:
    return a.value if isinstance(a, Lanes) else ir.Constant(_VECTOR, [float(a)] * WIDTH)


class _Rows:
    """Rows of a workspace: reading a row loads its eight lanes, assigning to it stores them."""

    def __init__(self, builder: Any, bases: Sequence[Any], ends: Sequence[int]) -> None:
        self.builder = builder
        self.bases = bases
        self.ends = ends

    def _at(self, row: int) -> Any:
        part = bisect(self.ends, operator.index(row))
        within = row - (self.ends[part - 1] if part else 0)
        return self.builder.gep(self.bases[part], [_WORD(within)])

    def __getitem__(self, row: int) -> Lanes:
        return Lanes(self.builder, self.builder.load(self._at(row), align=8))

    def __setitem__(self, row: int, value: Any) -> None:
        self.builder.store(_lift(value), self._at(row), align=8)


def _align_stack(builder: Any) -> None:
    """Align the stack, so that no vector on it crosses a cache line.

    The compiler aligns the stack for variables that require it, but not for values that it spills.
    Without alignment, a step of the environment takes 10 to 50 % longer, depending on the process.
    """
    vector = cgutils.alloca_once(builder, _VECTOR)  # type: ignore[no-untyped-call]
    vector.align = 8 * WIDTH
    use = ir.FunctionType(ir.VoidType(), [vector.type])
    builder.asm(use, "", "r", [vector], side_effect=True)  # keeps the unused vector on the stack


def kernel(function: Callable[[Any], None], ends: Sequence[int]) -> Any:
    """Return a numba function that runs ``function(rows)`` on a workspace of one or more parts.

    ``rows[i]`` reads row i as Lanes and ``rows[i] = value`` writes it. ``function`` is called only
    once, when numba compiles the caller. Every part is an array (rows, 8) of doubles. The rows
    are numbered from 0 through all parts; ``ends`` contains, for each part, the number of the row
    after its last. The numba function has one argument: a tuple of the parts' addresses.
    """

    @intrinsic  # type: ignore[untyped-decorator]
    def run(typing_context: Any, addresses: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _align_stack(builder)
            places = [builder.extract_value(arguments[0], i) for i in range(len(ends))]
            bases = [builder.inttoptr(place, _VECTOR.as_pointer()) for place in places]
            function(_Rows(builder, bases, ends))
            return context.get_dummy_value()

        return types.void(addresses), generate

    return run


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
            _load_transposed(block.ctypes.data, sources.ctypes.data, min(first, count - WIDTH))

    return compiled


def _compiled_scatter(kind: ir.Type) -> Callable[..., Any]:
    size = _BYTES[kind]
    put = _put(kind)
    store_transposed = _store_transposed(kind)

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
                store_transposed(block.ctypes.data, rows.ctypes.data, targets.ctypes.data, first)

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
def _load_transposed(_, block, sources, first):  # type: ignore[no-untyped-def]
    """Load numbers ``first`` to ``first`` + 7 of each source into the same rows of the block."""

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        block, sources, first = arguments
        offset = builder.mul(first, _WORD(8))
        places = [builder.add(_entry(builder, sources, lane), offset) for lane in range(WIDTH)]
        tile = [builder.load(_pointer(builder, place, _VECTOR), align=8) for place in places]
        row = builder.add(block, builder.mul(first, _WORD(8 * WIDTH)))
        for i, numbers in enumerate(_transpose(builder, tile)):
            place = builder.add(row, _WORD(8 * WIDTH * i))
            builder.store(numbers, _pointer(builder, place, _VECTOR), align=8)
        return context.get_dummy_value()

    return types.void(block, sources, first), build


def _store_transposed(kind: ir.Type) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def store_transposed(_, block, rows, targets, first):  # type: ignore[no-untyped-def]
        """Store ``rows[first:first + 8]`` as numbers ``first`` to ``first`` + 7 of each target."""

        def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            block, rows, targets, first = arguments
            size = _BYTES[kind]
            listed = builder.add(rows, builder.mul(first, _WORD(8)))
            numbers = [_entry(builder, listed, i) for i in range(WIDTH)]
            places = [builder.add(block, builder.mul(n, _WORD(8 * WIDTH))) for n in numbers]
            tile = [builder.load(_pointer(builder, place, _VECTOR), align=8) for place in places]
            offset = builder.mul(first, _WORD(size))
            narrow = ir.VectorType(kind, WIDTH)
            for lane, numbers in enumerate(_transpose(builder, tile)):
                place = builder.add(_entry(builder, targets, lane), offset)
                target = _pointer(builder, place, narrow)
                builder.store(_as(narrow, builder, numbers), target, align=size)
            return context.get_dummy_value()

        return types.void(block, rows, targets, first), build

    return store_transposed


def _transpose(builder: Any, tile: list[Any]) -> list[Any]:
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
    return builder.load(_pointer(builder, builder.add(address, _WORD(8 * i)), _WORD))


def _pointer(builder: Any, address: Any, kind: ir.Type) -> Any:
    return builder.inttoptr(address, kind.as_pointer())


def _as(kind: ir.Type, builder: Any, value: Any) -> Any:
    return value if value.type == kind else builder.fptrunc(value, kind)


overload(scatter)(_compiled_scatter(_DOUBLE))
overload(scatter_single)(_compiled_scatter(_SINGLE))
