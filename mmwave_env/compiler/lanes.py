"""Lanes: SIMD numbers with one value for each of eight environments.

They hide their values (:mod:`mmwave_env.numerics.tape`), and their recorder, an :class:`Emitter`,
emits LLVM ``<8 x double>`` instructions. To compile a function of numbers, :func:`kernel` calls it
once with lanes; the instructions emitted by this call are the compiled function, which has no
branches. If the function is called with floats, it runs as usual.

Lanes are stored in blocks (rows, 8): an environment is a column.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from mmwave_env.numerics.numbers import polynomial, where
from mmwave_env.numerics.pytree import Tree, flatten, unflatten
from mmwave_env.numerics.tape import Traced, Tracer, TracerCondition

WIDTH = 8
_WORD = ir.IntType(64)
_DOUBLE = ir.DoubleType()
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


def _bits(value: int) -> Any:
    return ir.Constant(_BITS, [value] * WIDTH)


def _doubles(value: float) -> Any:
    return ir.Constant(_VECTOR, [float(value)] * WIDTH)


def _atan2(y: Any, x: Any) -> Any:
    """Return the angle of (x, y), reduced to pi / 8 for a polynomial; error 2e-16."""
    ax = abs(x)
    ay = abs(y)
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
    return where(y < 0.0, -angle, angle)


def _log(a: Any) -> Any:
    """Return the natural logarithm of finite, positive, normal numbers; NaN for NaN."""
    b = a.recorder.builder
    bits = b.bitcast(a.value, _BITS)
    mantissa_bits = b.or_(b.and_(bits, _bits(0xFFFFFFFFFFFFF)), _bits(0x3FF0000000000000))
    m: Any = Tracer(a.recorder, b.bitcast(mantissa_bits, _VECTOR))
    exponent = b.sitofp(b.sub(b.lshr(bits, _bits(52)), _bits(1023)), _VECTOR)
    e: Any = Tracer(a.recorder, exponent)
    high = m > math.sqrt(2.0)
    m = where(high, 0.5 * m, m)
    e = where(high, e + 1.0, e)
    s = (m - 1.0) / (m + 1.0)
    return e * math.log(2.0) + 2.0 * s * polynomial(s * s, _ATANH) + (a - a)


def _exp(a: Any) -> Any:
    """Return the exponential of the numbers after limiting them to [-708, 708]."""
    b = a.recorder.builder
    x: Any = where(a < -708.0, -708.0, where(a > 708.0, 708.0, a))
    shifted = x * (1.0 / math.log(2.0)) + 1023.5  # positive, so truncation rounds down
    k = b.fptosi(shifted.value, _BITS)
    n: Any = Tracer(a.recorder, b.sitofp(k, _VECTOR)) - 1023.0
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    power = Tracer(a.recorder, b.bitcast(b.shl(k, _bits(52)), _VECTOR))
    return polynomial(r, _EXP) * power


def _circular(a: Any, cosine: bool) -> Any:
    """Return cosine or sine, if |a| < 1e5: reduced to pi / 4 or less, then polynomials."""
    b = a.recorder.builder
    rounded: Any = a * (2.0 / math.pi) + _ROUND
    quarters = b.bitcast(rounded.value, _BITS)
    turns = rounded - _ROUND
    r = (a - turns * _HALF_PI_HIGH) - turns * _HALF_PI_LOW
    z = r * r
    functions = [polynomial(z, _COS), r + r * z * polynomial(z, _SIN)]
    even, odd = functions if cosine else functions[::-1]
    is_odd = TracerCondition(a.recorder, b.trunc(quarters, ir.VectorType(ir.IntType(1), WIDTH)))
    value: Any = where(is_odd, odd, even)
    # negative where the second bit of this integer is set
    half_turns = b.add(quarters, _bits(1)) if cosine else quarters
    sign = b.shl(b.and_(half_turns, _bits(2)), _bits(62))
    return Tracer(a.recorder, b.bitcast(b.xor(b.bitcast(value.value, _BITS), sign), _VECTOR))


_FUNCTIONS: dict[str, Any] = {
    "atan2": _atan2,
    "log": _log,
    "exp": _exp,
    "cos": partial(_circular, cosine=True),
    "sin": partial(_circular, cosine=False),
}
# operations on floats and on words that are instructions of LLVM, and its intrinsic functions
_ON_FLOATS = ("fadd", "fsub", "fmul", "fdiv", "fneg")
_ON_WORDS = ("and_", "or_", "add", "xor", "shl", "lshr")
_INTRINSICS = ("fabs", "sqrt", "floor")
_COMPARISONS = ("<", "<=", ">", ">=")


class Emitter:
    """A recorder that emits the instructions of operations on lanes; values are LLVM's."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def emit(self, op: str, *operands: Any) -> Any:
        """Emit the instructions of an operation; return the value of its result."""
        if op in _FUNCTIONS:
            return _FUNCTIONS[op](*operands).value
        b = self.builder
        constant: Any = _bits if op in _ON_WORDS else _doubles
        x, *rest = [a.value if isinstance(a, Traced) else constant(a) for a in operands]
        if op in _ON_FLOATS:
            return getattr(b, op)(x, *rest, flags=_FLAGS)
        if op in _INTRINSICS:
            signature = ir.FunctionType(_VECTOR, [_VECTOR])
            function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
                b.module, signature, f"llvm.{op}.v{WIDTH}f64"
            )
            return b.call(function, [x], fastmath=_FLAGS)
        if op in _COMPARISONS:
            return b.fcmp_ordered(op, x, *rest)
        others = {
            "as word": lambda: b.bitcast(x, _BITS),
            "as number": lambda: b.bitcast(x, _VECTOR),
            "scaled": lambda: b.fmul(b.sitofp(x, _VECTOR), *rest, flags=_FLAGS),
        }
        return others[op]() if op in others else getattr(b, op)(x, *rest)


def _align_stack(builder: Any) -> None:
    """Align the stack, so that no vector on it crosses a cache line.

    The compiler aligns the stack for variables that require it, but not for values that it spills.
    Without alignment, a step of the environment takes 10 to 50 % longer, depending on the process.
    """
    vector = cgutils.alloca_once(builder, _VECTOR)  # type: ignore[no-untyped-call]
    vector.align = 8 * WIDTH
    use = ir.FunctionType(ir.VoidType(), [vector.type])
    builder.asm(use, "", "r", [vector], side_effect=True)  # keeps the unused vector on the stack


def kernel(
    function: Callable[[Tree], Tree], template: Tree, ends: Sequence[int] | None = None
) -> Any:
    """Return a numba function that applies a function of numbers to a workspace, in place.

    ``function`` maps a tree to a tree; both have the shape of the ``template``. It is called only
    once, when numba compiles the caller. The leaves of a tree, in order, are the rows of the
    workspace, which has one or more parts, arrays (rows, 8) of doubles. The numba function has one
    argument: a tuple of the parts' addresses.

    Args:
        function, template: the function, and an example of its argument.
        ends: for each part, the number of the row after its last, where rows are numbered from 0
            through all parts; None if there is one part.
    """
    parts = list(pairwise([0, *(ends or [len(flatten(template))])]))

    @intrinsic  # type: ignore[untyped-decorator]
    def run(typing_context: Any, addresses: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _align_stack(builder)
            emitter = Emitter(builder)
            places = []
            for part, (first, end) in enumerate(parts):
                address = builder.extract_value(arguments[0], part)
                base = builder.inttoptr(address, _VECTOR.as_pointer())
                places += [builder.gep(base, [_WORD(row)]) for row in range(end - first)]
            before = [Tracer(emitter, builder.load(place, align=8)) for place in places]
            after = flatten(function(unflatten(template, iter(before))))
            for place, old, new in zip(places, before, after, strict=True):
                if new is not old:
                    whole = new.value if isinstance(new, Tracer) else _doubles(new)
                    builder.store(whole, place, align=8)
            return context.get_dummy_value()

        return types.void(addresses), generate

    return run


@intrinsic  # type: ignore[untyped-decorator]
def number_at(_, address):  # type: ignore[no-untyped-def]
    """Return the number in double precision at an address; only compiled code can call this."""

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load(builder.inttoptr(arguments[0], _DOUBLE.as_pointer()))

    return types.float64(address), build
