"""Kinematics: which unknowns describe the deformation, and the deformation gradient that follows from them.

Everything else asks the object: F is always 3x3, a displacement always has three components.
"""

from __future__ import annotations

from remodel_fenicsx.fem.full_kinematics import FullKinematics, Kinematics
from remodel_fenicsx.fem.reduced_kinematics import (
    AxisymmetricKinematics,
    PointKinematics,
    RadialKinematics,
    SectorKinematics,
)

__all__ = ["KINEMATICS", "FullKinematics", "Kinematics"]

KINEMATICS: dict[str, Kinematics] = {
    kinematics.name: kinematics
    for kinematics in (
        FullKinematics(),
        SectorKinematics(),
        AxisymmetricKinematics(),
        RadialKinematics(),
        PointKinematics(),
    )
}
"""Kinematics by the name that a scene gives them."""
