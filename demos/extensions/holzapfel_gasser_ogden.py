"""The matrix of Gasser, Ogden and Holzapfel (2006): two families of fibres that stay, with dispersion.

    remodel-fenicsx run demos/artery.toml --with demos/extensions/holzapfel_gasser_ogden.py \\
        --set material.matrix=holzapfel-gasser-ogden --set material.chain_density=0.0 --set remodeling.law=none \\
        --set material.fibre_stiffness=5.0 --set material.fibre_angle=40.0 --set model.kinematics=radial

W = neo-Hooke + sum_i k1/(2 k2) (exp(k2 <E_i>^2) - 1), E_i = kappa I_1 + (1 - 3 kappa) a_i . C a_i - 1. The families lie
at +- fibre_angle from the circumferential to the axial direction. These are y and z of a tube on one radius
(model.kinematics = "radial"), and of a sheet or cube whose fibres lie in that plane.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from remodel_fenicsx.extend import MATRICES, Matrix, Parameter, neo_hookean


def distortional(
    F: Any,
    lame_lambda: Any,
    lame_mu: Any,
    fibre_stiffness: Any,
    fibre_exponent: Any,
    fibre_dispersion: Any,
    fibre_angle: Any,
) -> Any:
    """All but the volumetric part, per reference volume."""
    of, total = np if isinstance(F, np.ndarray) else ufl, neo_hookean.distortional(F, lame_lambda, lame_mu)
    columns = [[F[..., i, j] if of is np else F[i, j] for i in range(3)] for j in range(3)]
    first = sum(part**2 for column in columns for part in column)
    for sign in (1.0, -1.0):
        angle = sign * np.pi / 180.0 * fibre_angle
        carried = [a * of.cos(angle) + b * of.sin(angle) for a, b in zip(*columns[1:], strict=True)]
        fourth = sum(part**2 for part in carried)
        strain = fibre_dispersion * first + (1.0 - 3.0 * fibre_dispersion) * fourth - 1.0
        pulled = np.maximum(strain, 0.0) if of is np else ufl.max_value(strain, 0.0)
        total = total + fibre_stiffness / (2.0 * fibre_exponent) * (of.exp(fibre_exponent * pulled**2) - 1.0)
    return total


MATRICES["holzapfel-gasser-ogden"] = Matrix(
    lambda J, lame_lambda, lame_mu, **others: neo_hookean.volumetric(J, lame_lambda, lame_mu),
    distortional,
    parameters={
        "fibre_stiffness": Parameter(10.0, "k1 of the fibres, in the unit of stress.", above=0),
        "fibre_exponent": Parameter(10.0, "k2 of the fibres.", above=0),
        "fibre_dispersion": Parameter(0.0, "kappa of the fibres: 0 all in one direction, 1/3 in all.", above=-1e-12),
        "fibre_angle": Parameter(30.0, "Angle of the families to the circumferential direction, degrees."),
    },
)
