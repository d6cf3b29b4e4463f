"""ln C and its first two derivatives for many symmetric positive tensors at once, exact at repeated eigenvalues.

In the eigenbasis of C, with eigenvalues c_i (Daleckii and Krein):

    (D ln(C)[A])_ij          = f[c_i, c_j] A_ij
    (D^2 ln(C)[A, H])_ij     = sum_k f[c_i, c_k, c_j] (A_ik H_kj + H_ik A_kj)

f[...] are the divided differences of ln, symmetric in their arguments; where these agree they are derivatives, and what
is written here goes over into them without a difference of nearly equal numbers.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.mandel import MANDEL

Array = NDArray[np.float64]

CLOSE_EIGENVALUES = 1e-3
"""Relative distance of two or three eigenvalues below which a series stands for a quotient of differences: the quotient
loses eps / CLOSE, the series CLOSE^5."""


def first_divided_difference(a: Array, b: Array) -> Array:
    """f[a, b] = (ln a - ln b)/(a - b) of positive numbers, 1/a where they agree: atanh(x)/x at x = (a - b)/(a + b)."""
    x = (a - b) / (a + b)
    small = np.abs(x) < CLOSE_EIGENVALUES
    series = 1 + x**2 / 3 + x**4 / 5
    quotient = np.arctanh(np.where(small, 0.5, x)) / np.where(small, 0.5, x)
    return 2 / (a + b) * np.where(small, series, quotient)


def second_divided_difference(a: Array, b: Array, c: Array) -> Array:
    """f[a, b, c] of positive numbers; -1/(2 a^2) where they agree."""
    least, middle, largest = np.moveaxis(np.sort(np.stack(np.broadcast_arrays(a, b, c), axis=-1), axis=-1), -1, 0)
    first, last = first_divided_difference(middle, least), first_divided_difference(largest, middle)
    return _second_of_ordered(least, middle, largest, first, last)


def _second_of_ordered(least: Array, middle: Array, largest: Array, first: Array, last: Array) -> Array:
    """f[a, b, c] of ascending numbers, from f[a, b] and f[b, c]."""
    gap = largest - least
    close = gap < CLOSE_EIGENVALUES * largest
    result: Array = (last - first) / np.where(close, 1.0, gap)
    at = np.nonzero(close)
    if at[0].size:
        # Taylor: sum_n f^(n)(mean)/n! h_(n-2)(deviations), f^(n)/n! = (-1)^(n-1)/(n mean^n); h_1 = 0 about the mean
        three = np.stack([least[at], middle[at], largest[at]])
        mean = three.mean(axis=0)
        relative = three / mean - 1
        p2, p3, p4 = ((relative**power).sum(axis=0) for power in (2, 3, 4))
        result[at] = -(1 / 2 + p2 / 8 - p3 / 15 + p2**2 / 48 + p4 / 24) / mean**2
    return result


_last: list[tuple[Array, Array, Array]] = []  # tensors, values, vectors of the last question


def eigen(tensors: Array) -> tuple[Array, Array]:
    """Eigenvalues (n, 3), ascending, and eigenvectors as columns (n, 3, 3) of symmetric tensors (n, 3, 3), read-only.

    The last answer is kept: residual, tangent, driving stress, energy and power ask one after the other for the same
    tensors, and the decomposition is half of their work.
    """
    for known, *answer in _last:
        if np.array_equal(known, tensors):
            return answer[0], answer[1]
    values, vectors = np.linalg.eigh(tensors)
    for array in (values, vectors):
        array.flags.writeable = False
    _last[:] = [(tensors.copy(), values, vectors)]
    return values, vectors


def rotated(tensors: Array, vectors: Array) -> Array:
    """Q^T A Q: components in a basis given as columns."""
    return np.swapaxes(vectors, -1, -2) @ tensors @ vectors


def logarithm(tensors: Array) -> Array:
    """ln C, (n, 3, 3)."""
    values, vectors = eigen(tensors)
    return (vectors * np.log(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def derivative(values: Array, components: Array) -> Array:
    """D ln(C)[A] in the eigenbasis of C, from eigenvalues (n, 3) and the components of A there (n, 3, 3)."""
    return first_divided_differences(values) * components


def first_divided_differences(values: Array) -> Array:
    """f[c_i, c_j], (n, 3, 3): three quotients, and 1/c_i."""
    result = np.empty((*values.shape, 3))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        result[..., i, j] = result[..., j, i] = first_divided_difference(values[..., j], values[..., i])
    result[..., range(3), range(3)] = 1 / values
    return result


def second_derivative(values: Array, components: Array) -> Array:
    """Mandel matrix (n, 6, 6) of H -> D^2 ln(C)[A, H] in the eigenbasis of C; symmetric."""
    quotients = _all_second_differences(values)
    result = np.zeros((len(values), 6, 6))
    for row, (i, j) in enumerate(MANDEL):
        for column, (p, q) in enumerate(MANDEL):
            if {i, j} & {p, q} and column >= row:
                term = sum(_entry(quotients, components, i, j, *pair) for pair in ((p, q), (q, p)))
                weight = (1 if i == j else np.sqrt(2)) * (1 if p == q else np.sqrt(2)) / 2
                result[:, row, column] = result[:, column, row] = weight * term
    return result


def _entry(quotients: Array, components: Array, i: int, j: int, p: int, q: int) -> Array | float:
    """sum_k f[i, k, j] (A_ik H_kj + H_ik A_kj) for H = e_p e_q."""
    first = quotients[:, i, p, j] * components[:, i, p] if q == j else 0.0
    other = quotients[:, i, q, j] * components[:, q, j] if p == i else 0.0
    return first + other


def _all_second_differences(values: Array) -> Array:
    """f[c_i, c_j, c_k] of ascending values, (n, 3, 3, 3): ten different numbers."""
    result = np.empty((len(values), 3, 3, 3))
    pairs = {(i, j): first_divided_difference(values[:, j], values[:, i]) for i in range(3) for j in range(i, 3)}
    for i, j, k in itertools.combinations_with_replacement(range(3), 3):
        number = _second_of_ordered(values[:, i], values[:, j], values[:, k], pairs[i, j], pairs[j, k])
        for one, two, three in set(itertools.permutations((i, j, k))):
            result[:, one, two, three] = number
    return result
