"""Torsion of a tube: the end z = length is turned by an angle, the end z = 0 keeps its circle (torsion.toml)."""

import numpy as np

from remodel_fenicsx.extend import Column, LoadKind
from remodel_fenicsx.parts import Tube


def add_torsion(shape, loading, name):
    """Hold one end, and turn the other about z by an angle in degrees."""

    def turned(angle, places):
        x, y, _ = places.T
        cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, 0 * x], axis=1) - places * [
            1.0,
            1.0,
            0.0,
        ]

    for component in (0, 1):
        loading.hold_face("bottom", component)
    loading.add_prescribed_displacement(name, "top", turned, components=(0, 1))


def shear_stress(m):
    """Mean over the body of the Cauchy stress between the circumferential and the axial direction."""
    circumferential, axial, _ = np.moveaxis(m.state.cells.local_axes.deformed(m.F), -2, 0)
    return m.quadrature.mean(np.einsum("...i,...ij,...j->...", circumferential, m.stress, axial))


Tube.loads["torsion"] = LoadKind(
    add_torsion, "angle in degrees by which the end z = `length` is turned about z"
)
Tube.columns += (
    Column(
        "shear_stress",
        "stress",
        "mean shear stress between circumferential and axial",
        shear_stress,
    ),
)
