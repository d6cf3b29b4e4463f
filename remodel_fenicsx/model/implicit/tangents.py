"""dP/dF of P = F S from derivatives of S by C and by the rotation of F, on arrays of n points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model import mandel
from remodel_fenicsx.model.implicit.network import Strain

Array = NDArray[np.float64]


def of_deformation_gradient(strain: Strain, stress: Array, by_strain: Array) -> Array:
    """dP/dF of P = F S(C) from S and dS/dC in the global basis."""
    F, S = strain.gradient, strain.outside(stress)
    full = expanded(2 * by_strain)  # dS_IJ = full_IJAL F_kA dF_kL
    result: Array = np.einsum("niI,nIJAL->niJAL", F, full, optimize=True)
    result = np.einsum("nkA,niJAL->niJkL", F, result, optimize=True)
    for i in range(3):
        result[:, i, :, i, :] += S
    return result


def expanded(matrices: Array) -> Array:
    """Fourth-order tensors (n, 3, 3, 3, 3) of Mandel matrices (n, 6, 6)."""
    number = np.zeros((3, 3), dtype=int)
    for index, (i, j) in enumerate(mandel.MANDEL):
        number[i, j] = number[j, i] = index
    flat = number.reshape(-1)
    scaled = matrices / (mandel.FACTORS[:, None] * mandel.FACTORS[None, :])
    full: Array = scaled[:, flat[:, None], flat[None, :]].reshape(-1, 3, 3, 3, 3)
    return full


def turned(strain: Strain, tensor: Array) -> Array:
    """dX/dw of X = R D R^T for turns dR = R W, W_ij = w, W_ji = -w: Mandel vectors as columns (n, 6, 3)."""
    R = strain.rotation
    columns = []
    for i, j in mandel.PAIRS:
        change = np.zeros_like(tensor)
        change[:, i] = tensor[:, j]
        change[:, j] = -tensor[:, i]
        change = change + np.swapaxes(change, 1, 2)
        columns.append(mandel.vectors(R @ change @ np.swapaxes(R, 1, 2)))
    return np.stack(columns, axis=2)


def of_rotation(strain: Strain, by_turns: Array) -> Array:
    """dP/dF through the turns alone: F dS/dw dw/dF, w_ij = ((R^T dF)_ij - (R^T dF)_ji)/(u_i + u_j) in the basis."""
    F, Q, u = strain.gradient, strain.basis, strain.stretches
    RQ = F @ Q / u[:, None, :]
    result = np.zeros((len(F), 3, 3, 3, 3))
    for number, (i, j) in enumerate(mandel.PAIRS):
        stress = F @ mandel.tensors(by_turns[:, :, number])
        one = RQ[:, :, i, None] * Q[:, None, :, j]
        other = RQ[:, :, j, None] * Q[:, None, :, i]
        turn = (one - other) / (u[:, i] + u[:, j])[:, None, None]
        result += stress[:, :, :, None, None] * turn[:, None, None, :, :]
    return result
