"""Arrays of symmetric tensors: eigenvalues, logarithm, Mandel components; deformation gradients.

Arrays have shape (n, 3, 3). A symmetric tensor has six Mandel components in the order of `MANDEL`.
Off-diagonal components are multiplied by sqrt(2), so that the dot product of two component vectors
is A : B. A linear map between symmetric tensors is a matrix (n, 6, 6); the transposed map has the
transposed matrix.

ln C and its derivatives are exact at repeated eigenvalues. In the eigenbasis of C, with eigenvalues
c_i (Daleckii and Krein):

    (D ln(C)[A])_ij          = f[c_i, c_j] A_ij
    (D^2 ln(C)[A, H])_ij     = sum_k f[c_i, c_k, c_j] (A_ik H_kj + H_ik A_kj)

f[...] are the divided differences of ln, symmetric in their arguments. For equal arguments they are
derivatives; the functions below approach these without differences of nearly equal numbers.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.chains import UflOrArray

ufl = Late("ufl")
Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

CLOSE_EIGENVALUES = 1e-3
"""Relative difference of two or three eigenvalues below which a series replaces the quotient of
differences. The quotient loses eps / CLOSE_EIGENVALUES, the series CLOSE_EIGENVALUES^5."""


# ---------------------------------------------------------------- operations on UFL and arrays
# Tensors are arrays (..., 3, 3), vectors arrays (..., 3); the leading dimensions are points. A
# value that is neither a number nor an array is UFL. UFL is imported only then, because scenes are
# read and points computed without it.


def is_array(value: object) -> bool:
    """Return whether a value is a number or an array, not UFL."""
    return isinstance(value, (np.ndarray, np.generic, float, int, complex))


def ln(value: UflOrArray) -> UflOrArray:
    """Return the natural logarithm.

    Parameters
    ----------
    value
        A number, an array or UFL.

    Returns
    -------
    number, array or UFL
        ln of the value, of the same kind.

    Examples
    --------
    >>> from remodel_fenicsx.extend import ln
    >>> float(ln(1.0))
    0.0
    """
    if is_array(value):
        return np.log(value)
    return ufl.ln(value)


def sqrt(value: UflOrArray) -> UflOrArray:
    """Return the square root of a number, an array or UFL."""
    if is_array(value):
        return np.sqrt(value)
    return ufl.sqrt(value)


def det(tensor: UflOrArray) -> UflOrArray:
    """Return the determinants of arrays (..., 3, 3), or of UFL."""
    if is_array(tensor):  # np.linalg.det factorises each tensor and takes ten times as long
        (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(tensor, (-2, -1), (0, 1))
        return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return ufl.det(tensor)


def squared_norm(tensor: UflOrArray) -> UflOrArray:
    """Return A : A, the sum of the squares of all nine entries."""
    if is_array(tensor):
        return np.einsum("...ij,...ij->...", tensor, tensor)
    return ufl.inner(tensor, tensor)


# ---------------------------------------------------------------- Mandel components

MANDEL = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Entries of a symmetric tensor in the order of its Mandel components."""
ROWS, COLUMNS = (np.array(index) for index in zip(*MANDEL, strict=True))
PAIRS = MANDEL[3:]
"""Planes of two axes in the order of the off-diagonal Mandel components."""
FACTORS = np.where(ROWS == COLUMNS, 1.0, np.sqrt(2.0))


def to_mandel(tensors: Array) -> Array:
    """Return the Mandel components (..., 6) of symmetric tensors (..., 3, 3)."""
    return FACTORS * tensors[..., ROWS, COLUMNS]


def from_mandel(components: Array) -> Array:
    """Return the symmetric tensors (..., 3, 3) of Mandel components (..., 6)."""
    tensors = np.empty((*components.shape[:-1], 3, 3))
    tensors[..., ROWS, COLUMNS] = tensors[..., COLUMNS, ROWS] = components / FACTORS
    return tensors


def congruence(X: Array) -> Array:
    """Return the matrix (n, 6, 6) of H -> X H X^T."""
    # For a rotation it maps from the basis of its columns to global axes. By index it is
    # X_ia X_jb + X_ib X_ja.
    first, second = ROWS[:, None], COLUMNS[:, None]
    products = X[:, first, ROWS] * X[:, second, COLUMNS] + X[:, first, COLUMNS] * X[:, second, ROWS]
    return np.asarray(FACTORS[:, None] * FACTORS / 2 * products)


# ---------------------------------------------------------------- eigenvalues and logarithm


def stretch_tensor(stretches: Array, axes: Array) -> Array:
    """Return the tensors (..., 3, 3) with stretches (..., 3) along axes, rows (..., 3, 3)."""
    return np.swapaxes(axes, -1, -2) @ (stretches[..., None] * axes)


def rotated(tensors: Array, vectors: Array) -> Array:
    """Return Q^T A Q, the components in the basis of the columns of Q."""
    return np.swapaxes(vectors, -1, -2) @ tensors @ vectors


def logarithm(tensors: Array) -> Array:
    """Return ln C, (n, 3, 3)."""
    values, vectors = np.linalg.eigh(tensors)
    return (vectors * np.log(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def first_divided_difference(a: Array, b: Array) -> Array:
    """Return f[a, b] = (ln a - ln b)/(a - b) of positive numbers, 1/a if they agree."""
    # f[a, b] = 2/(a + b) atanh(x)/x with x = (a - b)/(a + b).
    x = (a - b) / (a + b)
    small = np.abs(x) < CLOSE_EIGENVALUES
    series = 1 + x**2 / 3 + x**4 / 5
    quotient = np.arctanh(np.where(small, 0.5, x)) / np.where(small, 0.5, x)
    return 2 / (a + b) * np.where(small, series, quotient)


def second_divided_difference(
    smallest: Array, middle: Array, largest: Array, first: Array, last: Array
) -> Array:
    """Return f[a, b, c] of ascending positive numbers from f[a, b] and f[b, c]."""
    # For equal numbers it is -1/(2 a^2).
    gap = largest - smallest
    close = gap < CLOSE_EIGENVALUES * largest
    result: Array = (last - first) / np.where(close, 1.0, gap)
    points = np.nonzero(close)
    if points[0].size:
        # Taylor: sum_n f^(n)(mean)/n! h_(n-2)(deviations), f^(n)/n! = (-1)^(n-1)/(n mean^n);
        # h_1 = 0 about the mean
        values = np.stack([smallest[points], middle[points], largest[points]])
        mean = values.mean(axis=0)
        relative = values / mean - 1
        p2, p3, p4 = ((relative**power).sum(axis=0) for power in (2, 3, 4))
        result[points] = -(1 / 2 + p2 / 8 - p3 / 15 + p2**2 / 48 + p4 / 24) / mean**2
    return result


def first_divided_differences(values: Array) -> Array:
    """Return f[c_i, c_j], (n, 3, 3): three quotients, and 1/c_i on the diagonal."""
    result = np.empty((*values.shape, 3))
    for i, j in PAIRS:
        result[..., i, j] = result[..., j, i] = first_divided_difference(
            values[..., j], values[..., i]
        )
    result[..., range(3), range(3)] = 1 / values
    return result


def second_divided_differences(values: Array) -> Array:
    """Return f[c_i, c_j, c_k] of ascending values, (n, 3, 3, 3): ten different numbers."""
    result, pairs = np.empty((len(values), 3, 3, 3)), first_divided_differences(values)
    for i, j, k in itertools.combinations_with_replacement(range(3), 3):
        number = second_divided_difference(
            values[:, i], values[:, j], values[:, k], pairs[:, i, j], pairs[:, j, k]
        )
        for first, second, third in set(itertools.permutations((i, j, k))):
            result[:, first, second, third] = number
    return result


def second_derivative(values: Array, components: Array) -> Array:
    """Return the symmetric matrix (n, 6, 6) of H -> D^2 ln(C)[A, H] in the eigenbasis of C."""
    f, A = second_divided_differences(values), components
    result = np.empty((len(values), 6, 6))
    for row, (i, j) in enumerate(MANDEL):
        for column, (p, q) in enumerate(MANDEL[: row + 1]):  # H = (e_p e_q + e_q e_p) / 2
            terms = [f[:, i, k, j] * A[:, i, k] for k, partner in ((p, q), (q, p)) if partner == j]
            terms += [f[:, i, k, j] * A[:, k, j] for k, partner in ((p, q), (q, p)) if partner == i]
            result[:, row, column] = result[:, column, row] = (
                FACTORS[row] * FACTORS[column] / 2 * sum(terms)
            )
    return result


# ---------------------------------------------------------------- deformation gradients


def determinant_changes_sign(before: Array, after: Array) -> Flags:
    """Return the points at which det((1 - s) F + s G) is not positive for an s in [0, 1]."""
    # Both ends may be admissible, because two axes can invert simultaneously. Exact: the
    # determinant is cubic in s.
    change = after - before
    determinants = [det(before + s * change) for s in (0.0, 1 / 3, 2 / 3, 1.0)]
    coefficients = np.linalg.solve(
        np.vander([0.0, 1 / 3, 2 / 3, 1.0], 4, increasing=True), np.stack(determinants)
    )
    _, linear, quadratic, cubic = coefficients
    with np.errstate(invalid="ignore", divide="ignore"):
        # Extrema: 3 c s^2 + 2 b s + a = 0 by the stable formula. A parabola has one root at
        # infinity.
        root = -(quadratic + np.copysign(np.sqrt(quadratic**2 - 3 * cubic * linear), quadratic))
        extrema = [np.where((s > 0) & (s < 1), s, 0.0) for s in (root / (3 * cubic), linear / root)]
    at_extrema = [np.polynomial.polynomial.polyval(s, coefficients, tensor=False) for s in extrema]
    lowest = np.min(at_extrema + determinants, axis=0)
    return lowest <= 1e-12 * np.max(
        determinants, axis=0
    )  # a double root may be positive by rounding


def cofactor(tensors: Array) -> Array:
    """Return J F^-T of arrays (..., 3, 3); each row is the cross product of two rows of F."""
    # The copy makes nine contiguous arrays.
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(tensors, (-2, -1), (0, 1)).copy()
    entries = [
        *(e * i - f * h, f * g - d * i, d * h - e * g),
        *(h * c - i * b, i * a - g * c, g * b - h * a),
        *(b * f - c * e, c * d - a * f, a * e - b * d),
    ]
    return np.stack(entries, axis=-1).reshape(np.shape(tensors))


def max_stretch_increment(before: Array, after: Array) -> Array:
    """Return the largest relative change of a length from F to G, (n,), to first order."""
    # sqrt(2/3) |E| with E the symmetric part of G F^-1 - 1. Without a change of volume it is the
    # largest |e_I| of a bar, and 2/sqrt(3) of the largest |e_I| in pure shear.
    change = after @ np.linalg.inv(before) - np.eye(3)
    strain = 0.5 * (change + np.swapaxes(change, 1, 2))
    return np.sqrt(2 / 3 * np.einsum("nij,nij->n", strain, strain))
