"""Formulations: the points at which elements take J, which decide whether they lock."""

# An element of low degree cannot keep J = 1 at all of its points and bend. It hardly deforms if
# lambda is much larger than every stiffness against shear (docs/solver.md, Volumetric locking).
# dolfinx is imported when needed: scenes, which name formulations, are read without it.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TYPE_CHECKING

import numpy as np

from remodel_fenicsx._renamed import with_old_names
from remodel_fenicsx._lazy import Late
from remodel_fenicsx.model.tensors import Array

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from ufl import Form
    from ufl.core.expr import Expr

    from remodel_fenicsx.fem.kinematics import Kinematics
    from remodel_fenicsx.fem.quadrature import Quadrature
    from remodel_fenicsx.model.cells import UnitCell
    from remodel_fenicsx.model.energy import Stresses, Tissue

ufl, basix = Late("ufl"), Late("basix")


class DiscreteFormulation:
    """Formulation on a mesh: energy, stresses and J that belong together; here J at all points."""

    jacobian: Any = None

    def __init__(self, quadrature: Quadrature):
        self.quadrature = quadrature

    def energies(
        self,
        tissue: Tissue,
        deformation_gradient: Expr,
        cells: Sequence[UnitCell],
        weight: Expr | float,
    ) -> list[Form]:
        """Return UFL forms that sum to the integral of W; `weight`: volume per unit of mesh."""
        # Each form is compiled by itself, because FFCx mixes up values of two quadrature rules in
        # one kernel.
        return [tissue.strain_energy(deformation_gradient, cells) * weight * self.quadrature.dx]

    def stresses(
        self,
        tissue: Tissue,
        deformation_gradient: Expr,
        cells: Sequence[UnitCell],
    ) -> Stresses:
        """Return the residual's UFL stresses at the points, which belong to the last `refresh`."""
        return tissue.stresses(deformation_gradient, cells)

    def refresh(self) -> None:
        """Update what `stresses` needs in addition to F from the present unknowns."""

    def jacobians(self) -> Array:
        """Return J at the formulation's own points, (elements, any), if it has any."""
        return np.empty((len(self.quadrature.elements), 0))


@with_old_names
class Formulation:
    """Formulation of elements: the points at which they take the volumetric part of the energy.

    Attributes
    ----------
    meaning
        Description for docs/scene.md.
    splits_energy
        Whether it needs a matrix energy with a separate volumetric part (`model.energy.Matrix`).
    locks
        Whether differences of J inside an element cost energy, so that nearly incompressible
        elements lock.

    Examples
    --------
    >>> from remodel_fenicsx.extend import FORMULATIONS
    >>> whole, selective = FORMULATIONS["displacement"], FORMULATIONS["selective-integration"]
    >>> whole.locks, selective.locks
    (True, False)
    >>> selective.applies_to("hexahedron", 1)
    True
    """

    meaning: str
    splits_energy: bool = False
    locks: bool = True

    def applies_to(self, element: str, degree: int) -> bool:
        """Return whether the formulation changes anything for an element.

        Parameters
        ----------
        element
            "hexahedron" or "tetrahedron".
        degree
            Degree of the displacement.
        """
        return True

    def auto_threshold(self, element: str, degree: int) -> float:
        """Return the lambda/mu above which "auto" takes the formulation for an element.

        Parameters
        ----------
        element, degree
            See `applies_to`.
        """
        return np.inf

    def discretise(
        self, kinematics: Kinematics, unknown: Function, quadrature: Quadrature
    ) -> DiscreteFormulation:
        """Return the formulation for these unknowns at these quadrature points.

        Parameters
        ----------
        kinematics, unknown, quadrature
            Kinematics, dolfinx function of the unknowns, and quadrature points.
        """
        return DiscreteFormulation(quadrature)


@dataclass(frozen=True)
class AtAllPoints(Formulation):
    """Formulation with the whole energy W at all quadrature points."""

    meaning: str


# ---------------------------------------------------------------- J at fewer points


@dataclass(frozen=True)
class Selective(Formulation):
    """Selective integration: the volumetric part by a rule of fewer points.

    Between the points of the rule J is their interpolating polynomial.

    Parameters
    ----------
    meaning
        Description for docs/scene.md.
    degrees
        Degree of that rule by element and degree. Elements without an entry would lock all the
        same.
    pays
        Largest lambda/mu for which "auto" still takes J at all points, by element. Without an entry
        "auto" always does.
    splits_energy, locks
        See `Formulation`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Selective
    >>> selective = Selective("volume at one point", {("hexahedron", 1): 1})
    >>> selective.applies_to("hexahedron", 1), selective.applies_to("tetrahedron", 1)
    (True, False)
    """

    meaning: str
    degrees: Mapping[tuple[str, int], int]
    pays: Mapping[str, float] = MappingProxyType({})
    splits_energy: bool = True
    locks: bool = False

    def applies_to(self, element: str, degree: int) -> bool:
        """Return whether there is a rule for the element."""
        return (element, degree) in self.degrees

    def auto_threshold(self, element: str, degree: int) -> float:
        """Return `pays` of the element, or infinity if there is no rule for it."""
        return self.pays.get(element, np.inf) if self.applies_to(element, degree) else np.inf

    def discretise(
        self, kinematics: Kinematics, unknown: Function, quadrature: Quadrature
    ) -> DiscreteFormulation:
        """Return the formulation with J at the points of the rule."""
        degree = self.degrees[quadrature.element_kind, quadrature.element_degree]
        return _SplitFormulation(kinematics, unknown, quadrature, degree)


class _SplitFormulation(DiscreteFormulation):
    def __init__(
        self,
        kinematics: Kinematics,
        unknown: Function,
        quadrature: Quadrature,
        degree: int,
    ):
        from remodel_fenicsx.fem import jit
        from remodel_fenicsx.fem.quadrature import shape_functions

        super().__init__(quadrature)
        self.dx = ufl.Measure("dx", domain=quadrature.mesh, metadata={"quadrature_degree": degree})
        kind = basix.CellType[quadrature.element_kind]
        points = np.asarray(basix.make_quadrature(kind, degree)[0], dtype=np.float64)
        jacobian = ufl.det(kinematics.elastic_gradient(unknown))
        self._expression = jit.expression(jacobian, points, "J where the formulation takes it")
        there, here = (
            shape_functions(kind.name, degree // 2, p)[0] for p in (points, quadrature.points)
        )
        # Exactly one value if the rule has one point.
        self._interpolation = here @ np.linalg.pinv(there)
        self.jacobian = quadrature.function("jacobian_of_the_formulation", ())
        self.refresh()

    def energies(
        self,
        tissue: Tissue,
        deformation_gradient: Expr,
        cells: Sequence[UnitCell],
        weight: Expr | float,
    ) -> list[Form]:
        distortional = tissue.distortional_energy(deformation_gradient, cells)
        volumetric = tissue.volumetric_energy(ufl.det(deformation_gradient))
        return [distortional * weight * self.quadrature.dx, volumetric * weight * self.dx]

    def stresses(
        self,
        tissue: Tissue,
        deformation_gradient: Expr,
        cells: Sequence[UnitCell],
    ) -> Stresses:
        return tissue.stresses_of_parts(deformation_gradient, cells, self.jacobian)

    def refresh(self) -> None:
        self.quadrature.values(self.jacobian, ())[:] = self.jacobians() @ self._interpolation.T

    def jacobians(self) -> Array:
        from remodel_fenicsx.fem.quadrature import expression_values

        rule, points = self.quadrature, self._interpolation.shape[1]
        return expression_values(self._expression, rule.mesh, rule.elements, points)[..., 0]


NOT_LOCKING = "selective-integration"
STIFF_BULK = {"hexahedron": 10.0, "tetrahedron": 300.0}
"""Largest lambda/mu for which "auto" takes J at all points (docs/reliability.md, Spurious
reorientation by pressure noise). In remodeling tubes linear hexahedra had errors of 0.1 degrees at
8.8, 2 degrees at 20, and 21 degrees and 8 % of the radii at 100. Quadratic tetrahedra had 0.6
degrees at 300; with U at one point their own error is 0.3 %."""

FORMULATIONS: dict[str, Formulation] = {
    # The measurements behind these numbers are in docs/reliability.md, Elements that lock.
    "displacement": AtAllPoints("at all quadrature points; a run whose elements lock warns"),
    NOT_LOCKING: Selective(
        "the volumetric part of the matrix at fewer points; not for tetrahedra of degree 1",
        {
            (kind, degree): degree
            for kind in ("hexahedron", "quadrilateral", "interval")
            for degree in (1, 2)
        }
        | {("tetrahedron", 2): 1},
        STIFF_BULK,
    ),
}
"""Formulations by their name in scenes."""
