"""Vectors of three numbers in compiled loops: tuples, or rows of arrays."""

from torchgrasp.foundation.fused import inlined


@inlined
def dot(a, b):
    """Return the dot product, a number, of two vectors: tuples or rows of arrays, of 3 numbers
    each.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    """Return the cross product of the vectors `a` and `b` of 3 numbers, as a tuple."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def add(a, b, factor):
    """Return `a` + `factor` `b` as a tuple; `a` and `b` are vectors of 3 numbers."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@inlined
def minus(a, b):
    """Return `a` - `b` as a tuple; both are vectors of 3 numbers."""
    return add(a, b, -1.0)


@inlined
def scale(v, factor):
    """Return the vector `v` of 3 numbers times the number `factor`, as a tuple."""
    return v[0] * factor, v[1] * factor, v[2] * factor


@inlined
def put(row, v):
    """Write the vector `v` of 3 numbers into the first 3 entries of the array `row`, in place."""
    for k in range(3):
        row[k] = v[k]


@inlined
def copy(to, values):
    """Write the array `values` into the array `to` of the same shape. Numba would take seconds to
    compile an assignment.
    """
    for k in range(values.size):
        to.flat[k] = values.flat[k]


@inlined
def insert(values, owners, value, owner):
    """Insert the number `value` among the ascending `values`, and its `owner` at the same place of
    `owners`.

    The last entry of each array drops out. The number must be below the last of `values`.
    """
    k = len(values) - 1
    while k > 0 and values[k - 1] > value:
        values[k] = values[k - 1]
        owners[k] = owners[k - 1]
        k -= 1
    values[k] = value
    owners[k] = owner


@inlined
def factorise(matrix):
    """Replace the lower half of a symmetric `matrix` (d, d) by its Cholesky factor.

    Return whether the matrix is positive definite; if not, its lower half is spoilt.
    """
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > 0.0:
                matrix[i, i] = rest**0.5
            else:
                return False
    return True


@inlined
def solve_factorised(factor, x):
    """Replace the right-hand side `x` (d,) of a linear system by its solution.

    `factor` is the lower Cholesky factor (d, d) of the matrix of the system.
    """
    d = len(x)
    for i in range(d):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(d - 1, -1, -1):
        for k in range(i + 1, d):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
