"""The axial force on the ends of a tube, in any kinematics and formulation, by virtual work."""

from __future__ import annotations

from typing import Any, NamedTuple

import basix.ufl
import dolfinx.fem
import numpy as np
import ufl
from mpi4py import MPI

from remodel_fenicsx.fem import jit
from remodel_fenicsx.solver.equilibrium import Equilibrium


class EndForce(NamedTuple):
    """What a virtual lengthening v = z/L e_z does, per unit of its displacement of the end z = L.

    Attributes
    ----------
    internal
        Work of the stresses, integral of P_zz over the body over L: a force.
    inward
        Flux of v through the deformed inner face, out of the wall: an area. It is 0 where the lumen is a cylinder.
    lumen
        Change of the volume between the inner face and plane caps: the lumen's area, at the end z = L, less `inward`.
    """

    internal: float
    inward: float
    lumen: float

    def of_the_wall(self, pressure: float) -> float:
        """The force that the wall carries through its section at z = L, with a pressure on the inner face.

        The bottom is where v is 0, and the field of any other unknown is in equilibrium: what the stresses work more
        than the pressure on the inner face is the work of the end.
        """
        return self.internal + pressure * self.inward

    def reduced(self, pressure: float) -> float:
        """The same less pressure times the lumen's area at z = L: what must be applied if the ends are capped."""
        return self.internal - pressure * self.lumen


class EndForceMeasure:
    """Compiles what `EndForce` is made of.

    Parameters
    ----------
    equilibrium
        Whose stresses, unknowns and cells it takes. Work is that of its residual to the last digit: of the formulation
        and the repulsion, with their quadrature.
    face
        Name of the inner face.
    length
        Of the reference body along z.
    """

    def __init__(self, equilibrium: Equilibrium, face: str, length: float):
        state, mesh = equilibrium.state, equilibrium.quadrature.mesh
        self._pointwise, self._comm = equilibrium.pointwise, equilibrium.comm
        weight, F = state.kinematics.weight(mesh), state.kinematics.deformation_gradient(state.unknown)
        # a function where a number would do: UFL differentiates by functions only, and some kinematics prescribe F_zz
        element = basix.ufl.element("DG", mesh.topology.cell_name(), 0)
        change: Any = dolfinx.fem.Function(dolfinx.fem.functionspace(mesh, element))
        one, size = (dolfinx.fem.Constant(mesh, np.float64(value)) for value in (1.0, length))
        along = ufl.as_tensor([[1.0 / size if i == j == 2 else 0.0 for j in range(3)] for i in range(3)])
        longer = F + change * along
        energies = state.dilatation.energies(equilibrium.tissue, longer, [state.cells.ufl_cell], weight)
        internal = [ufl.derivative(energy, change, one) for energy in energies]
        if self._pointwise is not None:
            work = ufl.inner(ufl.dot(F, self._pointwise.stress), along)
            internal[0] += work * weight * equilibrium.quadrature.dx
        self._internal = [jit.form(form) for form in internal]
        place, normal = ufl.SpatialCoordinate(mesh), ufl.FacetNormal(mesh)
        surface = state.loading.surface_measure(face)
        inward = ufl.dot(ufl.cofac(F), normal)[2] * place[2] / size
        moved = place + state.kinematics.displacement(state.unknown)
        # as in Loading.add_cavity_pressure: caps, across which z alone changes, add nothing
        across = ufl.as_vector([moved[0], moved[1], 0.0])
        volume = -ufl.inner(across, ufl.dot(ufl.cofac(longer), normal)) / 2 * weight * surface
        self._inward = jit.form(inward * weight * surface)
        self._lumen = jit.form(ufl.derivative(volume, change, one))

    def __call__(self) -> EndForce:
        """Of the present unknowns. Collective."""
        if self._pointwise is not None:
            self._pointwise.update()
        forms = (self._internal, [self._inward], [self._lumen])
        local = [sum(float(np.real(dolfinx.fem.assemble_scalar(form))) for form in group) for group in forms]
        return EndForce(*map(float, self._comm.allreduce(np.array(local), MPI.SUM)))
