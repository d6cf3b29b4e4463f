"""The chains of unit cells as lines to draw, and a file of them over time. This needs no dolfinx."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from remodel_fenicsx.results.vtkhdf import LINE, TransientGrid

AXIS_FIELDS = ("axis_1", "axis_2", "axis_3")
OF_CHAINS = (
    "cell_dimensions",
    *AXIS_FIELDS,
    "deformation_gradient",
    "fibre_angle",
)  # fields that the lines are made of


def chain_lines(
    centres: ArrayLike, lengths: ArrayLike, axes: ArrayLike, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The four chains of unit cells, +-l_1 n_1 +-l_2 n_2 +-l_3 n_3 through each centre (paper, Fig. 2).

    Eight corners do not depend on the order or the sign of the axes. Where l_3 = 0 the four lines lie on two.

    Parameters
    ----------
    centres
        Reference coordinates, shape (m, 3).
    lengths
        l_I in link lengths, shape (m, 3).
    axes
        n_I as rows, shape (m, 3, 3).
    scale
        Length in the mesh's unit that one link length is drawn with; a line is 2 |l| scale long.

    Returns
    -------
    points
        Ends, shape (8 m, 3): element by element, line by line, the two ends of a line after one another.
    lines
        Numbers of the two ends, shape (4 m, 2). Data of the elements go with `numpy.repeat(values, 4, axis=0)`.
    """
    middle = np.asarray(centres, dtype=np.float64)
    edges = np.asarray(lengths, dtype=np.float64)[:, :, None] * np.asarray(axes, dtype=np.float64)
    signs = np.array([(1.0, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)])
    half = scale * (signs @ edges)
    ends = middle[:, None, None, :] + np.stack([half, -half], axis=2)
    return ends.reshape(-1, 3), np.arange(8 * len(middle)).reshape(-1, 2)


def chain_displacement(
    points: ArrayLike, centres: ArrayLike, displacement: ArrayLike, deformation_gradient: ArrayLike
) -> NDArray[np.float64]:
    """Displacement of the ends that `chain_lines` gives, shape (8 m, 3): u + (F - I)(X_end - X_centre).

    With u (m, 3) and F (m, 3, 3) of the centres. ParaView's "Warp By Vector" then shows the deformed chains.
    """
    ends = np.asarray(points, dtype=np.float64).reshape(-1, 8, 3) - np.asarray(centres)[:, None, :]
    gradient = np.asarray(deformation_gradient) - np.eye(3)
    return (np.asarray(displacement)[:, None, :] + ends @ np.swapaxes(gradient, 1, 2)).reshape(-1, 3)


def append_chains(
    grid: TransientGrid | Path,
    time: float,
    centres: NDArray[np.float64],
    scale: float,
    displacement: NDArray[np.float64],
    fields: Mapping[str, NDArray[np.float64]],
) -> TransientGrid:
    """Add a step to a file of chain lines; it is made at its first step, where `grid` is still its path.

    With the displacement (m, 3) at the centres of the elements (m, 3), and their fields `OF_CHAINS`.
    """
    axes = np.stack([fields[name] for name in AXIS_FIELDS], axis=1)
    points, lines = chain_lines(centres, fields["cell_dimensions"], axes, scale)
    moved = chain_displacement(points, centres, displacement, fields["deformation_gradient"].reshape(-1, 3, 3))
    if isinstance(grid, Path):
        grid = TransientGrid(grid, points, lines, LINE, point_dtype=np.float32)
    angle = np.repeat(fields["fibre_angle"], len(lines) // len(centres))
    grid.append(time, {"displacement": moved}, {"fibre_angle": angle}, points=points)
    return grid
