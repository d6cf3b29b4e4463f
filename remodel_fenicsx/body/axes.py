"""Local axes, depth and station in any body with inner and outer face, inlet and outlet.

1. phi is harmonic, 0 on the inner and 1 on the outer face. Its unit gradients, projected onto
continuous vectors, are the radial direction. Raw gradients are those of plane facets, which are
inclined by up to half of their angle. 2. The axial direction is the smoothest vector field that is
normal to the ends and perpendicular to the radial direction. 3. Lengths along r from the inner and
the outer face give depth and thickness (Yezzi & Prince 2003); lengths along a from the ends give
the station.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import basix
import dolfinx.fem
import dolfinx.la
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from remodel_fenicsx._lazy import Late
from remodel_fenicsx.body.domain import Domain, cells_of, dof_of_node
from remodel_fenicsx.body.mesh_faces import ROLES, area_vectors
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import SpdSolver, LinearSolveFailure, allgather, allreduce
from remodel_fenicsx.fem.compat import geometry_dofmap
from remodel_fenicsx.fem.kinematics import lagrange
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.model.tensors import Array, Flags
from remodel_fenicsx.schema.tables import SceneError

if TYPE_CHECKING:
    from dolfinx.fem import DirichletBC, Function, FunctionSpace
    from dolfinx.mesh import Mesh
    from ufl.core.expr import Expr

spatial = Late("scipy.spatial")  # few bodies need it
Facets = NDArray[np.int32]

# Smallest |grad phi| over 1/thickness. An element with all its nodes on one face has no gradient of
# phi, and its 0/0 would spread to all nodes.
LEAST_SLOPE = 1e-6
# Weight of (a . r)^2 relative to |grad a|^2 times the squared thickness. In a bend the axes of 10
# and 1000 differ by 0.2 degrees (RMS).
SQUARE_TO_RADIAL = 10.0
TINY = 1e-12  # added to a squared length of about one, against division by zero


def _fields(domain: Domain, quadrature: Quadrature) -> list[Function]:
    """Compute radial and axial direction, and lengths from the four faces. Collective."""
    mesh, degree = domain.mesh, quadrature.element_degree
    inner, outer, starts, ends = map(domain.facets, ROLES)
    thickness = 2 * quadrature.volume / (area(mesh, inner) + area(mesh, outer))
    log.info("axes of the body: the radial directions")
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree})
    stiffness = slopes(mesh, degree, dx)
    radial = _radial(harmonic(stiffness, inner, outer), degree, dx, thickness)
    log.info("axes of the body: the axial directions")
    axial = _axial(radial, dx, starts, ends, thickness)
    log.info("axes of the body: depth and station")
    trial, test = _arguments(stiffness.space)
    r, a = _unit(radial), _unit(axial)
    along_r = SpdSolver(ufl.inner(r, ufl.grad(trial)) * ufl.inner(r, ufl.grad(test)) * dx)
    through = [
        _length(along_r, r, dx, facets, sign) for facets, sign in ((inner, 1.0), (outer, -1.0))
    ]
    # Unlike lengths through the wall, these are not along single lines, which would differ over the
    # section of a bend.
    along = [
        _length(stiffness, a, dx, facets, sign, True)
        for facets, sign in ((starts, 1.0), (ends, -1.0))
    ]
    return [radial, axial, *through, *along]


def slopes(mesh: Mesh, degree: int, dx: ufl.Measure) -> SpdSolver:
    """Assemble the form of harmonic functions. Collective."""
    trial, test = _arguments(lagrange(mesh, degree, ()).function_space)
    return SpdSolver(ufl.inner(ufl.grad(trial), ufl.grad(test)) * dx)


def harmonic(stiffness: SpdSolver, low: Facets, high: Facets, multigrid: bool = False) -> Function:
    """Compute the harmonic function that is 0 on some facets and 1 on others. Collective."""
    held = [_held(stiffness.space, low, 0.0), _held(stiffness.space, high, 1.0)]
    return stiffness.solve(None, held, multigrid)


def _radial(phi: Function, degree: int, dx: ufl.Measure, thickness: float) -> Function:
    """Project the unit gradients of the harmonic function onto continuous vectors."""
    mesh, slope = phi.function_space.mesh, ufl.grad(phi)
    trial, test = _arguments(phi.function_space)
    least, way = (
        dolfinx.fem.Constant(mesh, number)
        for number in (np.float64(LEAST_SLOPE / thickness), np.zeros(3))
    )
    direction = slope / ufl.sqrt(ufl.inner(slope, slope) + least**2)
    mass, directions = SpdSolver(trial * test * dx), lagrange(mesh, degree, (3,))
    for component in range(3):
        way.value[:] = np.eye(3)[component]
        directions.x.array[component::3] = mass.solve(ufl.inner(direction, way) * test * dx).x.array
    return directions


def _axial(
    radial: Function, dx: ufl.Measure, starts: Facets, ends: Facets, thickness: float
) -> Function:
    """Minimise the integral of |grad a|^2 + k (a . r)^2 / thickness^2, with the ends' normals."""
    space, normal = radial.function_space, _unit(radial)
    weight = dolfinx.fem.Constant(space.mesh, np.float64(SQUARE_TO_RADIAL / thickness**2))
    trial, test = _arguments(space)
    across = weight * ufl.inner(trial, normal) * ufl.inner(test, normal)
    smooth = SpdSolver((ufl.inner(ufl.grad(trial), ufl.grad(test)) + across) * dx)
    return smooth.solve(None, [_normal_to_ends(radial, starts, ends)], multigrid=True)


def _length(
    form: SpdSolver,
    direction: Expr,
    dx: ufl.Measure,
    facets: Facets,
    sign: float,
    multigrid: bool = False,
) -> Function:
    """Compute the function, 0 on facets, whose gradient fits a direction in the form's norm."""
    test, factor = ufl.TestFunction(form.space), dolfinx.fem.Constant(
        form.space.mesh, np.float64(sign)
    )
    flux = factor * ufl.inner(direction, ufl.grad(test)) * dx
    return form.solve(flux, [_held(form.space, facets, 0.0)], multigrid)


def _arguments(space: FunctionSpace) -> tuple[ufl.Argument, ufl.Argument]:
    return ufl.TrialFunction(space), ufl.TestFunction(space)


def _unit(vector: Expr) -> Expr:
    return vector / ufl.sqrt(ufl.inner(vector, vector) + TINY)


def _held(space: FunctionSpace, facets: Facets, value: float) -> DirichletBC:
    dofs = dolfinx.fem.locate_dofs_topological(space, space.mesh.topology.dim - 1, facets)
    held = dolfinx.fem.Constant(space.mesh, np.float64(value))
    return dolfinx.fem.dirichletbc(held, dofs, space)


def _normal_to_ends(function: Function, starts: Facets, ends: Facets) -> DirichletBC:
    """Prescribe inward normals on inlets and outward ones on outlets, averaged by area."""
    space, sums = function.function_space, dolfinx.fem.Function(function.function_space)
    values, layout = sums.x.array.reshape(-1, 3), space.dofmap.dof_layout
    for facets, sign in ((starts, -1.0), (ends, 1.0)):
        cells, local = cells_of(space.mesh, facets)
        for cell, number, vector in zip(
            cells, local, outward_areas(space.mesh, facets), strict=True
        ):
            values[space.dofmap.cell_dofs(int(cell))[layout.entity_closure_dofs(2, number)]] += (
                sign * vector
            )
    sums.x.scatter_reverse(dolfinx.la.InsertMode.add)
    sums.x.scatter_forward()
    sizes = np.linalg.norm(values, axis=1)
    dofs = np.flatnonzero(sizes).astype(np.int32)
    values[dofs] /= sizes[dofs, None]
    return dolfinx.fem.dirichletbc(sums, dofs)


# ---------------------------------------------------------------- facets
def outward_areas(mesh: Mesh, facets: Facets) -> Array:
    """Return area times outward normal of facets, (n, 3); zero if another rank owns the facet."""
    cells, number = cells_of(mesh, facets)
    of_facets, nodes = np.array(basix.topology(mesh.basix_cell())[2]), geometry_dofmap(mesh)[cells]
    if of_facets.shape[1] == 4:
        of_facets = of_facets[:, [0, 1, 3, 2]]  # dolfinx's order is a tensor product's
    corners = mesh.geometry.x[np.take_along_axis(nodes, of_facets[number], axis=1)]
    vectors = area_vectors(corners)
    middles = mesh.geometry.x[nodes].mean(axis=1)
    outwards = np.sign(np.sum(vectors * (corners.mean(axis=1) - middles), axis=1))
    owned = facets < mesh.topology.index_map(2).size_local
    return vectors * (outwards * owned)[:, None]


def area(mesh: Mesh, facets: Facets) -> float:
    """Return the area of facets, from their corners, over all ranks. Collective."""
    local = float(np.linalg.norm(outward_areas(mesh, facets), axis=1).sum())
    return allreduce(mesh.comm, local, MPI.SUM)


# ---------------------------------------------------------------- local axes, depth and station
# Values at the quadrature points of any body, from the fields of `_fields`.

log = logging.getLogger(__name__)

LEAST_RADIAL = 0.2  # length of the mean unit gradient: below it there is no common direction
LEAST_TANGENT = 0.1  # in-plane fraction of the axial field: below it the field crosses the wall
# Largest fraction of the volume without local axes. In 13 forks, coarse and fine, with one or two
# elements through the wall, it was 0.03 % at most, in the crotch. With half of the outer face named
# inner it was 0.7 % (a thick wall, fine) to 43 % (one element).
MOST_UNDEFINED = 0.01


class UndefinedAxes(SceneError):
    """Error: the local axes are undefined in more of the body than a few points."""


def compute_local_axes(domain: Domain, quadrature: Quadrature) -> LocalAxes:
    """Compute the local axes of a mesh with the faces `ROLES`. Collective."""
    if missing := [face for face in ROLES if face not in domain.faces]:
        raise UndefinedAxes(
            f"geometry.faces: the local axes need a face {', '.join(map(repr, missing))}"
        )
    try:
        radial, axial, *lengths = _fields(domain, quadrature)
    except LinearSolveFailure as stopped:
        raise UndefinedAxes(f"geometry.faces: cannot compute local axes: {stopped}") from stopped
    PETSc.garbage_cleanup(domain.mesh.comm)  # on several ranks unused matrices are only freed here
    fields = ufl.as_vector([*radial, *axial, *lengths])
    values = quadrature.evaluate(jit.expression(fields, quadrature.points), (len(fields),))
    axes, known = _axes(values[..., :3], values[..., 3:6])
    share = quadrature.mean((~known).astype(np.float64))
    if share > 0:
        x, y, z = _first_place(quadrature, ~known)
        words = (
            f"undefined in {100 * share:.2g} % of the wall, first at ({x:.4g}, {y:.4g}, {z:.4g})"
        )
        if share > MOST_UNDEFINED:
            raise UndefinedAxes(
                f"geometry.faces: the local axes are {words}; must be at most "
                f"{100 * MOST_UNDEFINED:g} %. Is there an outer face opposite the inner one?"
            )
        log.info("the local axes are %s; using those of the nearest point there", words)
        _fill(axes, known, quadrature)
    depth, station = (_share(values[..., k], values[..., k + 1]) for k in (6, 8))
    dofs = dof_of_node(domain.mesh, lengths[0].function_space)
    nodal = _share(*(np.real(length.x.array[dofs]) for length in lengths[:2]))
    makers = (lambda: axes), (lambda: depth), (lambda: station), (lambda: nodal)
    return LocalAxes(quadrature.coordinates, *makers, values[..., 6] + values[..., 7], ~known)


def _axes(radial: Array, axial: Array) -> tuple[Array, Flags]:
    """Return rows c, a, r from vectors of any length, and a mask of defined axes."""
    length, along = np.linalg.norm(radial, axis=-1), np.linalg.norm(axial, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):  # undefined axes are filled afterwards
        r = radial / length[..., None]
        tangent = axial - np.sum(axial * r, axis=-1)[..., None] * r
        size = np.linalg.norm(tangent, axis=-1)
        a = tangent / size[..., None]
    known: Flags = (length > LEAST_RADIAL) & (size > LEAST_TANGENT * along)
    return np.stack([np.cross(a, r), a, r], axis=-2), known


def _share(first: Array, second: Array) -> Array:
    """Return first / (first + second), clipped to [0, 1]: a few lengths are slightly negative."""
    low, high = np.maximum(first, 0.0), np.maximum(second, 0.0)
    total = low + high
    return np.divide(low, total, out=np.full_like(total, 0.5), where=total > 0)


def _first_place(quadrature: Quadrature, there: Flags) -> Array:
    """Return the first marked position, independent of the number of ranks. Collective."""
    marked = quadrature.owned(quadrature.coordinates)[quadrature.owned(there)]
    places = [place for part in allgather(quadrature.mesh.comm, marked) for place in part]
    return min(places, key=lambda place: np.round(place, 9).tolist())


def _fill(axes: Array, known: Flags, quadrature: Quadrature) -> None:
    """Copy the axes of the nearest point with axes to each point without. Collective."""
    good = quadrature.owned(known)
    own = quadrature.owned(quadrature.coordinates)[good], quadrature.owned(axes)[good]
    places, candidates = map(
        np.concatenate, zip(*allgather(quadrature.mesh.comm, own), strict=True)
    )
    axes[~known] = candidates[spatial.cKDTree(places).query(quadrature.coordinates[~known])[1]]
