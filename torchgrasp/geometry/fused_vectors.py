"""Vectors of three numbers in compiled loops: tuples, or rows of arrays."""

from torchgrasp.foundation.fused import inlined


@inlined
def dot(a, b):
    """Return the dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def add(a, b, factor):
    """Return a vector plus another one times a factor."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@inlined
def minus(a, b):
    """Return the difference of two vectors."""
    return add(a, b, -1.0)


@inlined
def scale(v, factor):
    """Return a vector times a factor, as a tuple."""
    return v[0] * factor, v[1] * factor, v[2] * factor


@inlined
def put(row, v):
    """Write a vector into a row of an array."""
    for k in range(3):
        row[k] = v[k]


@inlined
def copy(to, values):
    """Write an array of any shape into another one; an assignment takes seconds to compile."""
    for k in range(values.size):
        to.flat[k] = values.flat[k]


@inlined
def insert(values, owners, value, owner):
    """Insert a value among ascending `values`, and its owner likewise among `owners`.

    The last of each drops out. The value must be below the last of `values`.
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
    """Replace the lower half of a matrix by its Cholesky factor; return whether it is positive
    definite.
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
    """Solve for a vector x in place, given the lower Cholesky factor of the matrix."""
    d = len(x)
    for i in range(d):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(d - 1, -1, -1):
        for k in range(i + 1, d):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
