"""Small linear algebra on lists of numbers.

Matrices are lists of rows. A symmetric matrix is stored *packed*: its lower triangle, row
by row. An entry that is the plain constant ``0.0`` is a *structural zero*, for example the variance
of a coordinate that is known exactly. In compiled code, an addition of a structural zero or a
multiplication by it takes no instruction. No function below divides by a structural zero.
"""

from collections.abc import Callable, Sequence

from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Pair, Vector, sqrt


def is_zero(a: Number) -> bool:
    """Tell whether a number is a structural zero."""
    return isinstance(a, float) and a == 0.0


def dot(a: Vector, b: Vector) -> Number:
    """Return the inner product of two vectors; surplus entries of the longer one are ignored."""
    total: Number = 0.0
    for u, v in zip(a, b):  # noqa: B905 - rows of a triangle may be shorter than the vector
        total = total + u * v
    return total


def plus(a: Vector, b: Vector) -> Numbers:
    """Return the sum of two vectors; surplus entries of the longer one are ignored."""
    return [u + v for u, v in zip(a, b)]  # noqa: B905 - a position is the beginning of a state


def minus(a: Vector, b: Vector) -> Numbers:
    """Return the difference a - b of two vectors, as :func:`plus` does."""
    return [u - v for u, v in zip(a, b)]  # noqa: B905


def times(a: Vector, b: Vector) -> Numbers:
    """Return the products of the entries of two vectors of the same length."""
    return [u * v for u, v in zip(a, b, strict=True)]


def product(a: Matrix, b: Matrix) -> list[Numbers]:
    """Return the product of two matrices; surplus columns of ``a`` are ignored."""
    return [[dot(row, column) for column in zip(*b, strict=True)] for row in a]


def symmetric(n: int, entry: Callable[[int, int], Number]) -> Matrix:
    """Return the symmetric (n, n) matrix with elements ``entry(i, j)`` for i >= j."""
    m: list[Numbers] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            m[i][j] = m[j][i] = entry(i, j)
    return m


def pack(m: Matrix) -> Numbers:
    """Return the lower triangle of a symmetric matrix, row by row: n (n + 1) / 2 numbers."""
    return [m[i][j] for i in range(len(m)) for j in range(i + 1)]


def unpack(packed: Vector, zero: Sequence[int] = ()) -> Matrix:
    """Unpack a symmetric matrix; its rows and columns ``zero`` become structural zeros."""
    n = round((2 * len(packed) + 0.25) ** 0.5 - 0.5)
    return symmetric(
        n, lambda i, j: 0.0 if i in zero or j in zero else packed[i * (i + 1) // 2 + j]
    )


def cholesky(a: Matrix) -> Matrix:
    """Return the lower-triangular L with L L' = a; columns with a structurally zero pivot are 0."""
    n = len(a)
    factor: list[Numbers] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = a[j][j] - dot(factor[j][:j], factor[j][:j])
        if is_zero(pivot):
            continue
        factor[j][j] = sqrt(pivot)
        inverse = 1.0 / factor[j][j]
        for i in range(j + 1, n):
            factor[i][j] = (a[i][j] - dot(factor[i][:j], factor[j][:j])) * inverse
    return factor


def forward(factor: Matrix, b: Vector) -> Numbers:
    """Solve ``factor y = b`` for a factor from :func:`cholesky`; y_i is 0 where column i is 0."""
    y: Numbers = []
    for i in range(len(b)):
        pivot = factor[i][i]
        y.append(0.0 if is_zero(pivot) else (b[i] - dot(factor[i][:i], y)) * (1.0 / pivot))
    return y


def mahalanobis(a: Matrix, b: Vector) -> Pair:
    """Return b' a^-1 b and the determinant of a positive definite matrix ``a``."""
    factor = cholesky(a)
    y = forward(factor, b)
    pivots: Number = 1.0
    for i in range(len(a)):
        pivots = pivots * factor[i][i]
    return dot(y, y), pivots * pivots


def backward(factor: Matrix, b: Vector) -> Numbers:
    """Solve ``factor' y = b`` for a factor from :func:`cholesky`; y_i is 0 where column i is 0."""
    n = len(b)
    y: Numbers = [0.0] * n
    for i in reversed(range(n)):
        pivot = factor[i][i]
        if is_zero(pivot):
            continue
        rest = dot([factor[k][i] for k in range(i + 1, n)], y[i + 1 :])
        y[i] = (b[i] - rest) * (1.0 / pivot)
    return y
