"""A column of one's own, max_shear_strain: the largest shear anywhere in the body. Every run then records it.

    ./with-fenicsx remodel-fenicsx run demos/cube.toml --with demos/extensions/shear_column.py

At a point it is the difference of the largest and the smallest principal value of the Green-Lagrange strain
E = (F^T F - 1) / 2: by so much the right angle between two fibres changes where it changes most. Of small strains it is
the engineering shear strain.
"""

import numpy as np

from remodel_fenicsx.extend import COLUMNS, Column, Measurement


def max_shear_strain(measurement: Measurement) -> float:
    F = measurement.state.deformation_gradient()  # (points, 3, 3)
    strains = np.linalg.eigvalsh(F.swapaxes(1, 2) @ F - np.eye(3)) / 2  # ascending, (points, 3)
    shear = strains[:, 2] - strains[:, 0]
    return measurement.quadrature.maximum(shear.reshape(measurement.quadrature.shape))


COLUMNS["max_shear_strain"] = Column(
    "max_shear_strain",
    "",
    "largest difference of principal strains in the body",
    max_shear_strain,
    extreme=True,
)
