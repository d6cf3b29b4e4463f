"""Unit cells that follow from measured fibres: structure tensors, fibre directions or fibre angles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.model.spectral import principal

Array = NDArray[np.float64]

# name of what is measured: numbers that a row of it may have
MEASURED = {"structure_tensor": (9, 6), "fibre": (3,), "angle": (1,), "fibre_2": (3,), "weight": (1,)}
SOURCES = ("structure_tensor", "fibre", "angle")  # one of these is needed
SYMMETRIC = np.array([0, 3, 5, 3, 1, 4, 5, 4, 2])  # of xx, yy, zz, xy, yz, xz (VTK's order), row by row
# eigenvalue below zero, over the trace, that may be rounding of files with 7 digits
FILE_ROUNDING = 1e-6


def fault_of_fibres(measured: Mapping[str, Array]) -> str | None:
    """What keeps rows (n, columns) by name of `MEASURED` from being fibres, in words; None if nothing does."""
    sources = [name for name in SOURCES if name in measured]
    if len(sources) != 1:
        return f"has {' and '.join(sources) or 'none'} of {', '.join(SOURCES)}; exactly one is needed"
    for name, values in measured.items():
        if values.shape[1] not in MEASURED[name]:
            numbers = " or ".join(map(str, MEASURED[name]))
            return f"{name} has {values.shape[1]} numbers in a row; allowed is {numbers}"
        if not (fine := np.isfinite(values).all(axis=1)).all():
            return _row(name, fine, "is not finite")
    (source,) = sources
    for name, of in (("fibre_2", ("fibre",)), ("weight", ("fibre", "angle"))):
        if name in measured and source not in of:
            return f"has {name} beside {source}; it belongs to {' or '.join(of)}"
    for name in ("fibre", "fibre_2"):
        if name in measured and not (fine := (measured[name] != 0).any(axis=1)).all():
            return _row(name, fine, "is the zero vector")
    weight = measured.get("weight", np.zeros((1, 1)))[:, 0]
    if not (fine := (weight >= 0) & (weight <= 1)).all():
        return _row("weight", fine, "is not from 0 to 1")
    if source == "structure_tensor":
        eigenvalues = np.linalg.eigvalsh(_tensors(measured[source]))
        trace = eigenvalues.sum(axis=1)
        if not (fine := (trace > 0) & (eigenvalues[:, 0] >= -FILE_ROUNDING * trace)).all():
            return _row(source, fine, f"has eigenvalues {', '.join(f'{v:.3g}' for v in eigenvalues[~fine][0])}; "
                        "none may be below 0, nor all be 0")  # fmt: skip
    return None


def _row(name: str, fine: Any, what: str) -> str:
    return f"{name} of row {int(np.argmin(fine)) + 1} {what}"


def structure_tensors(measured: Mapping[str, Array], axes: Array) -> Array:
    """A of any size at points, (..., 3, 3); `cells_of` scales it.

    Parameters
    ----------
    measured
        Without a fault (`fault_of_fibres`), by name: (..., columns). `structure_tensor`: 9 numbers row by row, of which
        the symmetric part is seen, or xx, yy, zz, xy, yz, xz. `fibre` and `fibre_2`: directions, of any length.
        `angle`: degrees from circumferential towards axial. `weight`: share of the first fibres, the rest is that of
        the second ones (1/2 without it), or where there are none, of fibres in all directions (nothing without it):
        w f (x) f + (1 - w) I / 3.
    axes
        Circumferential, axial, radial, as rows, (..., 3, 3).
    """
    if "structure_tensor" in measured:
        return _tensors(measured["structure_tensor"])
    if "angle" in measured:
        angle = np.radians(measured["angle"])
        first = np.cos(angle) * axes[..., 0, :] + np.sin(angle) * axes[..., 1, :]
    else:
        first = measured["fibre"]
    others = _along(measured["fibre_2"]) if "fibre_2" in measured else np.eye(3) / 3
    usual = np.full((*first.shape[:-1], 1), 0.5 if "fibre_2" in measured else 1.0)
    weight = measured.get("weight", usual)[..., None]
    return weight * _along(first) + (1 - weight) * others


def cells_of(tensors: Array, end_to_end_length: float, previous: Array) -> tuple[Array, Array]:
    """l_I (..., 3), longest first, and n_I as rows (..., 3, 3) of cells with A = r0^2 T / tr T of tensors T.

    Where tensors leave axes open (equal eigenvalues), they are those of `previous`, (..., 3, 3).
    """
    shape = tensors.shape[:-2]
    values, axes = principal(tensors.reshape(-1, 3, 3), previous.reshape(-1, 3, 3))
    values = np.maximum(values, 0.0)
    lengths = end_to_end_length * np.sqrt(values / values.sum(axis=1, keepdims=True))
    return lengths.reshape(*shape, 3), axes.reshape(*shape, 3, 3)


def _tensors(rows: Array) -> Array:
    """Symmetric (..., 3, 3) of rows of 9 or 6 numbers."""
    full = rows if rows.shape[-1] == 9 else rows[..., SYMMETRIC]
    tensors = full.reshape(*rows.shape[:-1], 3, 3)
    return (tensors + np.swapaxes(tensors, -1, -2)) / 2


def _along(vectors: Array) -> Array:
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit[..., :, None] * unit[..., None, :]
