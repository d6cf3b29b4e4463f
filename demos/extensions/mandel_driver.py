"""The Mandel stress as what the cells follow; with its derivatives, so that the coupling "implicit" takes it.

    remodel-fenicsx run demos/cube.toml --with demos/extensions/mandel_driver.py --set remodeling.driver=mandel

It is C S, in material space. Of a tensor that is not symmetric the cells follow the symmetric part.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from remodel_fenicsx.extend import DRIVERS, Driver, linear_map


def mandel_stress(F: Any, stresses: Any) -> Any:
    """C S; UFL."""
    import ufl

    return ufl.dot(ufl.dot(F.T, F), stresses.second_piola_kirchhoff)


def derivatives(squared: np.ndarray, S: np.ndarray, second: bool) -> tuple[Any, Any, Any]:
    """D = sym(C S), dD/dS and dD/dC at n points, in the eigenbasis of C; squared: its eigenvalues, (n, 3)."""
    C = squared[:, :, None] * np.eye(3)
    D = (C @ S + S @ C) / 2
    if not second:
        return D, None, None
    return D, linear_map(lambda change: C @ change), linear_map(lambda change: change @ S)


DRIVERS["mandel"] = Driver(mandel_stress, material=True, derivatives=derivatives)
