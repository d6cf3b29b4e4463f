"""Formulations: where an element takes the change of volume, which decides whether it locks in a stiff bulk.

An element of low degree cannot keep J = 1 at all of its points and bend; where lambda is much larger than every
stiffness against shear it then hardly moves (docs/theory.md, Volumetric locking). dolfinx is imported when needed:
scenes, which name formulations, are read without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx._lazy import Late

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from ufl import Form
    from ufl.core.expr import Expr

    from remodel_fenicsx.fem.kinematics import Kinematics
    from remodel_fenicsx.fem.quadrature import Quadrature
    from remodel_fenicsx.model.cells import UnitCell
    from remodel_fenicsx.model.energy import Stresses, Tissue

ufl, basix = Late("ufl"), Late("basix")
Array = NDArray[np.float64]


class Dilatation:
    """A formulation on a mesh: the energy's integral, and stresses and J to go with it; here J at all points."""

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
        """UFL forms whose sum is the integral of W over the body; `weight` is the body's volume per unit of mesh."""
        # They are compiled one by one: FFCx mixes up values of two quadrature rules that meet in one kernel.
        return [tissue.strain_energy(deformation_gradient, cells) * weight * self.quadrature.dx]

    def stresses(
        self,
        tissue: Tissue,
        deformation_gradient: Expr,
        cells: Sequence[UnitCell],
    ) -> Stresses:
        """Stresses (UFL) at the quadrature points, as the residual has them. They belong to the last `refresh`."""
        return tissue.stresses(deformation_gradient, cells)

    def refresh(self) -> None:
        """Take what `stresses` needs beside F from the present unknowns."""

    def jacobians(self) -> Array:
        """J of the present unknowns where the formulation takes it beside the quadrature points, (elements, any)."""
        return np.empty((len(self.quadrature.elements), 0))


class Formulation:
    """What scenes, states and warnings ask of a formulation.

    Attributes
    ----------
    meaning
        What it does, for docs/scene.md.
    takes_parts
        Whether it needs a matrix energy whose volumetric part is told apart (`model.energy.Matrix`).
    locks
        Whether differences of J inside an element cost energy: elements lock where the bulk is stiff.

    Examples
    --------
    >>> from remodel_fenicsx.extend import FORMULATIONS
    >>> whole, selective = FORMULATIONS["displacement"], FORMULATIONS["selective-integration"]
    >>> whole.locks, selective.locks
    (True, False)
    >>> selective.has("hexahedron", 1)
    True
    """

    meaning: str
    takes_parts: bool = False
    locks: bool = True

    def has(self, element: str, degree: int) -> bool:
        """Whether it changes anything for such an element.

        Parameters
        ----------
        element
            "hexahedron" or "tetrahedron".
        degree
            Of the displacement.
        """
        return True

    def pays_above(self, element: str, degree: int) -> float:
        """The lambda/mu from which on "auto" takes it for such an element.

        Parameters
        ----------
        element, degree
            As in `has`.
        """
        return np.inf

    def on(self, kinematics: Kinematics, unknown: Function, quadrature: Quadrature) -> Dilatation:
        """The formulation for these unknowns at these points.

        Parameters
        ----------
        kinematics, unknown, quadrature
            What the unknowns mean, their dolfinx function, and the points.
        """
        return Dilatation(quadrature)


@dataclass(frozen=True)
class AtAllPoints(Formulation):
    """W as it stands, at all quadrature points."""

    meaning: str


# ---------------------------------------------------------------- J at fewer points


@dataclass(frozen=True)
class Selective(Formulation):
    """The volumetric part by a rule of fewer points; in between, its J is the polynomial through them.

    Parameters
    ----------
    meaning
        What it does, for docs/scene.md.
    degrees
        Degree of that rule by element and degree; what is not in it would lock all the same.
    pays
        Least lambda/mu for which "auto" takes it, by element; it never does for one that is not in it.
    takes_parts, locks
        As in `Formulation`.

    Examples
    --------
    >>> from remodel_fenicsx.extend import Selective
    >>> selective = Selective("volume at one point", {("hexahedron", 1): 1})
    >>> selective.has("hexahedron", 1), selective.has("tetrahedron", 1)
    (True, False)
    """

    meaning: str
    degrees: Mapping[tuple[str, int], int]
    pays: Mapping[str, float] = MappingProxyType({})
    takes_parts: bool = True
    locks: bool = False

    def has(self, element: str, degree: int) -> bool:
        """Where there is a rule."""
        return (element, degree) in self.degrees

    def pays_above(self, element: str, degree: int) -> float:
        """By element, where there is a rule."""
        return self.pays.get(element, np.inf) if self.has(element, degree) else np.inf

    def on(self, kinematics: Kinematics, unknown: Function, quadrature: Quadrature) -> Dilatation:
        """With J at the points of the rule."""
        degree = self.degrees[quadrature.element_kind, quadrature.element_degree]
        return _PartsApart(kinematics, unknown, quadrature, degree)


class _PartsApart(Dilatation):
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
        there, here = (shape_functions(kind.name, degree // 2, p)[0] for p in (points, quadrature.points))
        self._interpolation = here @ np.linalg.pinv(there)  # exactly one and the same where the rule has one point
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
        return self._expression.eval(self.quadrature.mesh, self.quadrature.elements)[..., 0]


NOT_LOCKING = "selective-integration"
STIFF_BULK = {"hexahedron": 10.0, "tetrahedron": 300.0}
"""Largest lambda/mu with which "auto" takes J at all points (docs/what_may_go_wrong.md, Cells that turn). Of tubes that
remodel linear hexahedra lost 0.1 degrees at 8.8, 2 degrees at 20, 21 degrees and 8 % of the radii at 100. Quadratic
tetrahedra lost 0.6 degrees at 300; with U at one point they have 0.3 % of error of their own."""

FORMULATIONS: dict[str, Formulation] = {
    # docs/what_may_go_wrong.md, Elements that lock, has the measurements behind these numbers
    "displacement": AtAllPoints("at all quadrature points; a run whose elements lock warns"),
    NOT_LOCKING: Selective(
        "the volumetric part of the matrix at fewer points; not for tetrahedra of degree 1",
        {(kind, degree): degree for kind in ("hexahedron", "quadrilateral", "interval") for degree in (1, 2)}
        | {("tetrahedron", 2): 1},
        STIFF_BULK,
    ),
}
"""Formulations by the name that a scene gives them."""
