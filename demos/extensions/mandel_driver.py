"""The Mandel stress as what the cells follow.

    remodel-fenicsx run demos/cube.toml --with demos/extensions/mandel_driver.py --set remodeling.driver=mandel

It is C S, in material space. Of a tensor that is not symmetric the cells follow the symmetric part.
"""

from __future__ import annotations

from typing import Any

from remodel_fenicsx.extend import DRIVERS, Driver


def mandel_stress(F: Any, stresses: Any) -> Any:
    """C S; UFL."""
    import ufl

    return ufl.dot(ufl.dot(F.T, F), stresses.second_piola_kirchhoff)


DRIVERS["mandel"] = Driver(mandel_stress, material=True)
