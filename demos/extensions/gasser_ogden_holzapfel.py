"""The matrix of Gasser, Ogden and Holzapfel (2006): two families of fibres, with four keys of its own in [material].

    remodel-fenicsx run demos/hypertension.toml --with demos/extensions/gasser_ogden_holzapfel.py \\
        --set material.matrix=gasser-ogden-holzapfel --set material.family_angle=40

    W = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J + sum over families k1/(2 k2) (exp(k2 E^2) - 1)
    E = max(kappa tr C + (1 - 3 kappa) a . C a - 1, 0)

The families lie at both sides of the second axis, in the plane of the second and the third: the circumference and the
length of a tube on its radius (model.kinematics = "radial"), where the first axis is the radius.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from remodel_fenicsx.extend import MATRICES, Matrix, Parameter, neo_hookean


def families(
    F: Any, lame_lambda: Any, mu: Any, fibre_stiffness: Any, fibre_exponent: Any, **more: Any
) -> Any:
    """The energy of both, of F in UFL or of arrays (..., 3, 3)."""
    on_arrays = isinstance(F, np.ndarray)
    C = np.moveaxis(np.swapaxes(F, -1, -2) @ F, (-2, -1), (0, 1)) if on_arrays else F.T * F
    math, angle, dispersion = (
        np if on_arrays else ufl,
        more["family_angle"] * np.pi / 180,
        more["dispersion"],
    )
    energy = 0.0
    for side in (-1.0, 1.0):
        c, s = math.cos(angle), side * math.sin(angle)
        along = c**2 * C[1, 1] + 2 * c * s * C[1, 2] + s**2 * C[2, 2]
        strain = dispersion * (C[0, 0] + C[1, 1] + C[2, 2]) + (1 - 3 * dispersion) * along - 1
        pulled = (
            np.maximum(strain, 0) if on_arrays else (strain + abs(strain)) / 2
        )  # arrays may be complex
        energy += (
            fibre_stiffness / (2 * fibre_exponent) * (math.exp(fibre_exponent * pulled**2) - 1)
        )
    return energy


MATRICES["gasser-ogden-holzapfel"] = Matrix(
    neo_hookean.volumetric,
    *neo_hookean.others,
    families,
    parameters={
        "fibre_stiffness": Parameter(5.0, "k1, in the unit of stress.", exclusive_minimum=0),
        "fibre_exponent": Parameter(15.0, "k2.", exclusive_minimum=0),
        "family_angle": Parameter(40.0, "Of each family to the circumference, in degrees."),
        "dispersion": Parameter(0.1, "kappa: 0 for one direction, 1/3 for all."),
    },
)
