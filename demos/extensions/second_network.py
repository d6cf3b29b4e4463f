"""A second network of chains that does not remodel, elastin-like, with four keys of its own in [material].

    remodel-fenicsx run demos/biaxial/two_networks.toml --with demos/extensions/second_network.py

    W = Neo-Hookean matrix + c (w(r) - g(1)/2 sum over the axes a_i ln C_ii),  r^2 = sum a_i C_ii,  sum a_i = 1

w and g are energy and stiffness of a wormlike chain whose length is 1 without load (paper, eq. 4, in the form "log").
Its cells stay along the axes of the scene: x, y and z of a sheet; of a tube on its radius (model.kinematics = "radial")
the radius, the circumference and the length.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from remodel_fenicsx.extend import CHAINS, MATRICES, Matrix, Parameter, neo_hookean

CHAIN = CHAINS["wormlike"]


def network(
    F: Any,
    lame_lambda: Any,
    mu: Any,
    second_modulus: Any,
    second_contour_length: Any,
    **shares: Any,
) -> Any:
    """The energy of the chains, of F in UFL or of arrays (..., 3, 3)."""
    on_arrays = isinstance(F, np.ndarray)
    C = np.moveaxis(np.swapaxes(F, -1, -2) @ F, (-2, -1), (0, 1)) if on_arrays else F.T * F
    math, second, third = (
        np if on_arrays else ufl,
        shares["second_share_2"],
        shares["second_share_3"],
    )
    log = np.log if on_arrays else ufl.ln
    along = [(1 - second - third, C[0, 0]), (second, C[1, 1]), (third, C[2, 2])]
    length = math.sqrt(sum(share * squared for share, squared in along))
    repulsion = (
        CHAIN.stiffness(1.0, second_contour_length)
        / 2
        * sum(share * log(squared) for share, squared in along)
    )
    return second_modulus * (CHAIN.energy(length, second_contour_length) - repulsion)


MATRICES["with-second-network"] = Matrix(
    neo_hookean.volumetric,
    *neo_hookean.others,
    network,
    parameters={
        "second_modulus": Parameter(10.0, "c, in the unit of stress.", exclusive_minimum=0),
        "second_contour_length": Parameter(
            2.0, "Over the length without load: the stretch that locks.", exclusive_minimum=1
        ),
        "second_share_2": Parameter(
            1 / 3, "Of squared dimensions along the second axis, a_2.", exclusive_minimum=0
        ),
        "second_share_3": Parameter(
            1 / 3, "Along the third, a_3; a_1 is what is left.", exclusive_minimum=0
        ),
    },
)
