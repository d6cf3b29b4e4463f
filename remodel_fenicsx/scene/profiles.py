"""Profiles: how much accuracy a run shall have, as settings with the error and cost that were measured on the artery.

They are points of the front of docs/speed_and_accuracy.md; `remodel-fenicsx trade SCENE` measures any scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from remodel_fenicsx.schema.tables import fault
from remodel_fenicsx.schema.toml import put

EXACT = "implicit"  # coupling


@dataclass(frozen=True)
class Profile:
    """Settings that go together.

    Attributes
    ----------
    values
        Over those of the preset, by dotted key.
    takes_exact_coupling
        Whether the coupling is `EXACT` too where that leaves no error in time (`Scene.has_exact_coupling`).
    degrees, percent, seconds
        Error of the fibre angle, root mean square, and of the radii, and time of the processor in the steps, as
        measured on the paper's artery with isotropic cells.
    """

    values: dict[str, Any]
    degrees: float
    percent: float
    seconds: float
    takes_exact_coupling: bool = False

    def in_words(self, name: str) -> str:
        """What it was measured to be."""
        settings = ", ".join(f"{key} = {value}" for key, value in self.values.items())
        if self.takes_exact_coupling:
            settings += f", remodeling.coupling = {EXACT} where that leaves no error in time"
        return (
            f"profile {name!r}: {settings}; measured on the artery of isotropic cells: {self.degrees:g} degrees, radii "
            f"{self.percent:g} %, {self.seconds:g} s (docs/speed_and_accuracy.md)"
        )

    def tables(self) -> dict[str, Any]:
        """Its values as tables of a scene."""
        tables: dict[str, Any] = {}
        for key, value in self.values.items():
            put(tables, key, value)
        return tables


def _values(refinement: int, degree: int, tolerance: float) -> dict[str, Any]:
    values = {"model.kinematics": "auto", "mesh.refinement": refinement, "mesh.degree": degree}
    return values | {"time.tolerance": tolerance}


PROFILES: dict[str, Profile] = {
    "fast": Profile(_values(1, 1, 1.0), 1.4, 0.7, 0.2),
    "balanced": Profile(_values(1, 2, 0.5), 0.5, 0.5, 0.4),
    "reference": Profile(_values(2, 2, 0.1), 0.0036, 0.0008, 1.4, takes_exact_coupling=True),
}


def known_profile(name: Any) -> Profile:
    """The profile of a name.

    Raises
    ------
    PydanticCustomError
        A `fault` if there is none.
    """
    if not isinstance(name, str) or name not in PROFILES:
        raise fault("allowed are " + ", ".join(map(repr, PROFILES)), "profile", name)
    return PROFILES[name]
