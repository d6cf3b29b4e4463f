"""A body whose length is one more unknown: the axial force is given, or a pressure acts on caps at its ends.

The field of any other kinematics keeps u_z = 0 at both ends; all of it is stretched by one number e, the change of the
length: u + e z/length e_z. The number belongs to all elements, so its row of the tangent is full.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.fem import compat
from remodel_fenicsx.fem.full_kinematics import Body, Kinematics

Array = NDArray[np.float64]


class FreeLength:
    """Another kinematics, its unknown (u, e) instead of u.

    Parameters
    ----------
    kinematics
        On a mesh; what is not said here it answers itself.
    body
        Whose length it is.
    """

    def __init__(self, kinematics: Kinematics, body: Body):
        self.field, self.body = kinematics, body

    def __getattr__(self, name: str) -> Any:
        if name == "field":  # while it is copied it has none
            raise AttributeError(name)
        return getattr(self.field, name)

    def unknown(self, mesh: Any, degree: int) -> Any:
        """(u, e), zero."""
        import basix.ufl
        import dolfinx.fem
        from petsc4py import PETSc

        element = self.field.unknown(mesh, degree).function_space.ufl_element()
        number = basix.ufl.element("DG", mesh.topology.cell_name(), 0)
        space = dolfinx.fem.functionspace(mesh, basix.ufl.mixed_element([element, number]))
        unknown = dolfinx.fem.Function(with_one_value(space, 1), name="displacement")
        nodes, self._dofs = unknown.function_space.sub(0).collapse()
        self._nodal = dolfinx.fem.Function(nodes)
        length: Any = PETSc.ScalarType(self.body.axial_length)  # type: ignore[attr-defined]
        self._length = dolfinx.fem.Constant(mesh, length)
        return unknown

    def change_of_length(self, unknown: Any) -> Any:
        """e, UFL; linear in the unknown."""
        import ufl

        return ufl.split(unknown)[1]

    def displacement(self, unknown: Any) -> Any:
        """u + e z/length e_z."""
        import ufl

        u, change = ufl.split(unknown)
        z = ufl.SpatialCoordinate(unknown.ufl_function_space().mesh)[2]
        return self.field.displacement(u) + ufl.as_vector([0.0, 0.0, change * z / self._length])

    def deformation_gradient(self, unknown: Any) -> Any:
        """The field's, and e/length along z."""
        import ufl

        u, change = ufl.split(unknown)
        stretch = change / self._length
        return self.field.deformation_gradient(u) + ufl.as_tensor(
            [[stretch if i == j == 2 else 0.0 for j in range(3)] for i in range(3)]
        )

    def subspace(self, space: Any, component: int) -> Any:
        """The field's."""
        return self.field.subspace(space.sub(0), component)

    def nodal_space(self, unknown: Any) -> Any:
        """The field's."""
        return self.field.nodal_space(self._nodal)

    def nodal_displacement(self, unknown: Any) -> Array:
        """Displacement of the local nodes, (nodes, 3)."""
        self._nodal.x.array[:] = unknown.x.array[self._dofs]
        places: Array = self.nodal_space(unknown).tabulate_dof_coordinates()
        displacement = self.field.nodal_displacement(self._nodal).copy()
        displacement[:, 2] += self.strain_of_length(unknown) * places[:, 2]
        return displacement

    def strain_of_length(self, unknown: Any) -> float:
        """e/length; the same on every rank."""
        dofs = unknown.function_space.sub(1).dofmap.list.flatten()
        here = float(unknown.x.array[dofs[0]]) if len(dofs) else -np.inf
        return float(unknown.function_space.mesh.comm.allreduce(here, MPI.MAX)) / self.body.axial_length


def with_one_value(space: Any, component: int) -> Any:
    """A mixed space in which a component, constant in each element, has one value for the whole mesh. Collective.

    The first rank with elements owns it, for all others it is a ghost.
    """
    import dolfinx.la

    dofmap, comm = space.dofmap, space.mesh.comm
    old = dofmap.index_map
    is_one = np.zeros(old.size_local + old.num_ghosts, dtype=bool)
    is_one[space.sub(component).dofmap.list.flatten()] = True
    owned, ghosts = ~is_one[: old.size_local], ~is_one[old.size_local :]
    has_elements = len(dofmap.list) > 0
    owner = comm.allreduce(comm.rank if has_elements else comm.size, MPI.MIN)
    is_owner = comm.rank == owner
    size = int(owned.sum()) + is_owner
    offset = comm.exscan(size) or 0
    numbers = dolfinx.la.vector(old, 1, dtype=np.float64)  # exact for whole numbers
    numbers.array[: old.size_local][owned] = offset + np.arange(owned.sum())
    numbers.scatter_forward()
    one = comm.bcast(offset + int(owned.sum()), root=owner)
    is_ghost = has_elements and not is_owner
    new_ghosts = numbers.array[old.size_local :][ghosts].astype(np.int64)
    owners = np.asarray(old.owners)[ghosts]
    if is_ghost:
        new_ghosts, owners = np.append(new_ghosts, one), np.append(owners, owner)
    place = np.zeros(len(is_one), dtype=np.int32)
    place[: old.size_local][owned] = np.arange(owned.sum())
    place[old.size_local :][ghosts] = size + np.arange(ghosts.sum())
    place[is_one] = size - 1 if is_owner else size + ghosts.sum()
    return compat.space_with_dofs(space, size, new_ghosts, owners.astype(np.int32), place[dofmap.list])


def field_degree(space: Any) -> int:
    """Polynomial degree of a kinematics' unknown, of the field where there is a number beside it."""
    element = space.ufl_element()
    return int((element.sub_elements or [element])[0].degree)
