"""Supports and loads of the shapes, as a scene names them: dead traction, follower pressure, prescribed stretch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from remodel_fenicsx.fem import jit
from remodel_fenicsx.body import Domain
from remodel_fenicsx.fem.kinematics import deformation_gradient

LoadValues = dict[str, float]


class Loading:
    """What holds and drives a body: boundary conditions, external forces, and their magnitudes by name.

    Parameters
    ----------
    domain
        The meshed body with its named faces.
    displacement
        dolfinx vector function, the unknown.

    Attributes
    ----------
    boundary_conditions
        dolfinx Dirichlet conditions.
    values
        Present magnitude of each named load.
    """

    def __init__(self, domain: Domain, displacement: Any):
        self.domain, self.displacement = domain, displacement
        self.space = displacement.function_space
        self.boundary_conditions: list[Any] = []
        self.values: LoadValues = {}
        self._magnitudes: dict[str, tuple[Any, float]] = {}
        self._terms: list[Callable[[Any, Any], Any]] = []

    # ------------------------------------------------------------ supports
    def hold_face(self, face: str, component: int) -> None:
        """u_component = 0 on a named face."""
        self._prescribe(component, self._face_dofs(face, component), self._constant(0.0))

    def hold_node(self, point: tuple[float, float, float], component: int) -> None:
        """u_component = 0 at the mesh node at `point`.

        Raises
        ------
        ValueError
            If the mesh has no node there.
        """
        tolerance = 1e-9 * self.domain.size
        subspace = self.space.sub(component)
        collapsed, _ = subspace.collapse()
        dofs = dolfinx.fem.locate_dofs_geometrical(
            (subspace, collapsed), lambda x: np.linalg.norm(x - np.reshape(point, (3, 1)), axis=0) < tolerance
        )
        owned = subspace.dofmap.index_map.size_local * subspace.dofmap.index_map_bs
        found = self.domain.mesh.comm.allreduce(int(np.sum(dofs[0] < owned)), MPI.SUM)
        if found != 1:
            raise ValueError(f"{found} mesh nodes at {point}: a support needs exactly one")
        # on the sub-space's own dofs alone the value is a Constant, as for faces
        self._prescribe(component, dofs[0], self._constant(0.0))

    # ------------------------------------------------------------ loads
    def add_dead_force(self, name: str, face: str, component: int) -> None:
        """A total force on a face: constant nominal traction, force over reference area, along a coordinate axis."""
        area = self.area(face)
        traction = self._magnitude(name)
        direction = ufl.as_vector([1.0 if i == component else 0.0 for i in range(3)])
        measure = self._surface_measure(face)
        self._terms.append(lambda u, v: -traction / area * ufl.inner(direction, v) * measure)

    def add_follower_pressure(self, name: str, face: str) -> None:
        """A pressure on the deformed face, against its outward normal: p cof(F) N . v, with the exact linearisation."""
        pressure = self._magnitude(name)
        normal = ufl.FacetNormal(self.domain.mesh)
        measure = self._surface_measure(face)
        self._terms.append(lambda u, v: pressure * ufl.inner(ufl.cofac(deformation_gradient(u)) * normal, v) * measure)

    def add_prescribed_stretch(self, name: str, face: str, component: int, length: float) -> None:
        """u_component = stretch * length on a face: the engineering strain of the whole length."""
        displacement = self._magnitude(name, length)
        self._prescribe(component, self._face_dofs(face, component), displacement)

    def add_term(self, term: Callable[[Any, Any], Any]) -> None:
        """Any other load, as a term of the residual: minus its virtual work.

        Parameters
        ----------
        term
            Function of displacement and test function that returns a UFL form: ``lambda u, v: -ufl.inner(b, v) * dx``
            is a body force b per reference volume. Its derivative with respect to the displacement enters the tangent.
        """
        self._terms.append(term)

    def external_residual(self, displacement: Any, test: Any) -> list[Any]:
        """Terms of the residual from the loads: minus the virtual work of the external forces (UFL)."""
        return [term(displacement, test) for term in self._terms]

    def set(self, values: Mapping[str, float]) -> None:
        """Give the named loads new magnitudes.

        Raises
        ------
        KeyError
            If a name is not a load of this body.
        """
        for name, value in values.items():
            constant, scale = self._magnitudes[name]
            constant.value = value * scale
            self.values[name] = float(value)

    def area(self, face: str) -> float:
        """Reference area of a named face."""
        one = dolfinx.fem.Constant(self.domain.mesh, PETSc.ScalarType(1.0))
        local = dolfinx.fem.assemble_scalar(jit.form(one * self._surface_measure(face)))
        return float(np.real(self.domain.mesh.comm.allreduce(local, MPI.SUM)))

    # ------------------------------------------------------------ inside
    def _constant(self, value: float) -> Any:
        return dolfinx.fem.Constant(self.domain.mesh, PETSc.ScalarType(value))

    def _magnitude(self, name: str, scale: float = 1.0) -> Any:
        constant = self._constant(0.0)
        self._magnitudes[name] = (constant, scale)
        self.values[name] = 0.0
        return constant

    def _surface_measure(self, face: str) -> Any:
        measure = ufl.Measure("ds", domain=self.domain.mesh, subdomain_data=self.domain.facet_tags)
        degree = self.space.element.basix_element.degree
        return measure(self.domain.faces[face], metadata={"quadrature_degree": 2 * degree})

    def _face_dofs(self, face: str, component: int) -> Any:
        facets = self.domain.facet_tags.find(self.domain.faces[face])
        return dolfinx.fem.locate_dofs_topological(self.space.sub(component), self.domain.mesh.topology.dim - 1, facets)

    def _prescribe(self, component: int, dofs: Any, value: Any) -> None:
        self.boundary_conditions.append(dolfinx.fem.dirichletbc(value, dofs, self.space.sub(component)))


def cube_loading(domain: Domain, displacement: Any) -> Loading:
    """Uniaxial tension of a cube along z (Fig. 5): symmetry planes x = y = z = 0, a dead `force` on z = side."""
    loading = Loading(domain, displacement)
    for component, face in enumerate(("x0", "y0", "z0")):
        loading.hold_face(face, component)
    loading.add_dead_force("force", "z1", component=2)
    return loading


def tendon_loading(domain: Domain, displacement: Any) -> Loading:
    """Tendon (Fig. 6): u_z = 0 at the bottom, rigid motion held at two of its nodes, a dead `force` at the top."""
    loading = Loading(domain, displacement)
    loading.hold_face("bottom", 2)
    loading.hold_node((0.0, 0.0, 0.0), 0)
    loading.hold_node((0.0, 0.0, 0.0), 1)
    loading.hold_node((domain.dimensions["radius"], 0.0, 0.0), 1)
    loading.add_dead_force("force", "top", component=2)
    return loading


def tube_loading(domain: Domain, displacement: Any) -> Loading:
    """Artery (Fig. 7): inner follower `pressure`, axial `stretch` of the ends, rigid motion held at three nodes."""
    loading = Loading(domain, displacement)
    radius = domain.dimensions["inner_radius"]
    loading.hold_face("bottom", 2)
    loading.hold_node((radius, 0.0, 0.0), 1)
    loading.hold_node((-radius, 0.0, 0.0), 1)
    loading.hold_node((0.0, radius, 0.0), 0)
    loading.add_prescribed_stretch("stretch", "top", component=2, length=domain.dimensions["length"])
    loading.add_follower_pressure("pressure", "inner")
    return loading


LOADINGS: dict[str, Callable[[Domain, Any], Loading]] = {
    "cube": cube_loading,
    "tendon": tendon_loading,
    "tube": tube_loading,
}
