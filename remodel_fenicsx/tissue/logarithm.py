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

Array = NDArray[np.float64]

CLOSE = 1e-3
"""Relative distance of three eigenvalues below which a series stands for a quotient of differences: the quotient loses
eps / CLOSE, the series CLOSE^5."""


def first_divided_difference(a: Array, b: Array) -> Array:
    """f[a, b] = (ln a - ln b)/(a - b) of positive numbers, 1/a where they agree: atanh(x)/x at x = (a - b)/(a + b)."""
    x = (a - b) / (a + b)
    small = np.abs(x) < 1e-3
    series = 1 + x**2 / 3 + x**4 / 5
    quotient = np.arctanh(np.where(small, 0.5, x)) / np.where(small, 0.5, x)
    return 2 / (a + b) * np.where(small, series, quotient)


def second_divided_difference(a: Array, b: Array, c: Array) -> Array:
    """f[a, b, c] of positive numbers; -1/(2 a^2) where they agree."""
    ordered = np.sort(np.stack(np.broadcast_arrays(a, b, c), axis=-1), axis=-1)
    least, middle, largest = (ordered[..., i] for i in range(3))
    mean = (least + middle + largest) / 3
    gap = largest - least
    close = gap < CLOSE * mean
    difference = first_divided_difference(largest, middle) - first_divided_difference(middle, least)
    quotient = difference / np.where(close, 1.0, gap)
    # Taylor: sum_n f^(n)(mean)/n! h_(n-2)(deviations), f^(n)/n! = (-1)^(n-1)/(n mean^n); h_1 = 0 about the mean
    relative = (ordered - mean[..., None]) / mean[..., None]
    p2, p3 = (relative**2).sum(-1), (relative**3).sum(-1)
    series = -(1 / 2 + p2 / 8 - p3 / 15 + p2**2 / 48 + (relative**4).sum(-1) / 24) / mean**2
    return np.where(close, series, quotient)


def eigen(tensors: Array) -> tuple[Array, Array]:
    """Eigenvalues (n, 3) and eigenvectors as columns (n, 3, 3) of symmetric tensors (n, 3, 3)."""
    values, vectors = np.linalg.eigh(tensors)
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
    return first_divided_difference(values[..., :, None], values[..., None, :]) * components


def second_derivative(values: Array, components: Array) -> Array:
    """T of D^2 ln(C)[A, H]_ij = T_ijpq H_pq in the eigenbasis of C, with all symmetries, (n, 3, 3, 3, 3)."""
    quotients = _all_second_differences(values)
    scaled = quotients * components[:, :, :, None]  # f[c_i, c_k, c_j] A_ik, j last
    whole = np.zeros((len(values), 3, 3, 3, 3))
    for j in range(3):
        whole[:, :, j, :, j] += scaled[..., j]  # A_ik H_kj: p = k, q = j
        whole[:, j, :, j, :] += scaled[..., j]  # H_ik A_kj: p = i, q = k; symmetric in the other two
    return (whole + np.swapaxes(whole, -1, -2)) / 2


def _all_second_differences(values: Array) -> Array:
    """f[c_i, c_j, c_k], (n, 3, 3, 3): ten different numbers."""
    triples = list(itertools.combinations_with_replacement(range(3), 3))
    columns = np.array(triples).T
    different = second_divided_difference(*(values[:, column] for column in columns))
    result = np.empty((len(values), 3, 3, 3))
    for number, triple in enumerate(triples):
        for i, j, k in set(itertools.permutations(triple)):
            result[:, i, j, k] = different[:, number]
    return result
