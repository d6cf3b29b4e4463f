"""Symmetric tensors of many points as six Mandel components, and linear maps between them as 6 x 6 matrices.

Components are in the order of `MANDEL`; those off the diagonal are times sqrt(2), so that the product of two
vectors is the product A : B of the tensors, and the matrix of a map is transposed where the map is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MANDEL = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Entries of a symmetric tensor in the order of its components."""
ROWS, COLUMNS = (np.array(index) for index in zip(*MANDEL, strict=True))
PAIRS = MANDEL[3:]
"""Planes of two axes, in the order in which their turns stand after three lengths."""
FACTORS = np.where(ROWS == COLUMNS, 1.0, np.sqrt(2.0))


def vectors(tensors: Array) -> Array:
    """Mandel components (n, 6) of symmetric tensors (n, 3, 3)."""
    found: Array = FACTORS * tensors[:, ROWS, COLUMNS]
    return found


def tensors(components: Array) -> Array:
    """Symmetric tensors (n, 3, 3) of Mandel components (n, 6)."""
    found = np.empty((len(components), 3, 3))
    found[:, ROWS, COLUMNS] = found[:, COLUMNS, ROWS] = components / FACTORS
    return found


def diagonal(entries: Array) -> Array:
    """Matrix (n, 6, 6) of the map that multiplies component ij of a tensor by entry ij (n, 3, 3)."""
    found = np.zeros((len(entries), 6, 6))
    found[:, np.arange(6), np.arange(6)] = entries[:, ROWS, COLUMNS]
    return found


def congruence(matrices: Array) -> Array:
    """Matrix (n, 6, 6) of H -> X H X^T, from X (n, 3, 3); of a rotation: from its columns to the global axes."""
    result = np.empty((len(matrices), 6, 6))
    for row, (i, j) in enumerate(MANDEL):
        for column, (a, b) in enumerate(MANDEL):
            product = matrices[:, i, a] * matrices[:, j, b] + matrices[:, i, b] * matrices[:, j, a]
            weight = (1 if i == j else np.sqrt(2)) * (1 if a == b else np.sqrt(2)) / 2
            result[:, row, column] = weight * product
    return result


def symmetric_product(matrices: Array) -> Array:
    """Matrix (n, 6, 6) of H -> H Y + Y^T H, from Y (n, 3, 3)."""
    found = np.zeros((len(matrices), 6, 6))
    for column, (a, b) in enumerate(MANDEL):
        weight = 1.0 if a == b else np.sqrt(0.5)
        image = np.zeros((len(matrices), 3, 3))
        image[:, a] += weight * matrices[:, b]
        if a != b:
            image[:, b] += weight * matrices[:, a]
        found[:, :, column] = vectors(image + np.swapaxes(image, 1, 2))
    return found


def dyads(left: Array, right: Array) -> Array:
    """Matrix (n, 6, 6) of H -> a (b : H), from Mandel components (n, 6)."""
    found: Array = left[:, :, None] * right[:, None, :]
    return found


def on_diagonal(values: Array) -> Array:
    """Mandel components (n, 6) of diagonal tensors, from (n, 3)."""
    return np.concatenate([values, np.zeros_like(values)], axis=1)
