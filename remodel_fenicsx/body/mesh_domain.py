"""Mesh of a user-supplied body on all ranks, with its faces and supports."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TYPE_CHECKING

import dolfinx.fem
import dolfinx.graph
import dolfinx.io
import dolfinx.mesh
import numpy as np
import ufl
from mpi4py import MPI
from numpy.typing import NDArray

from remodel_fenicsx.body.axes import harmonic, slopes
from remodel_fenicsx.body.domain import Domain, cells_of, symbolic_mesh
from remodel_fenicsx.body.mesh_faces import Boundary, Face, cap_volume, node_order, rims_of
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.body.mesh_file import MeshFile
from remodel_fenicsx.fem import jit
from remodel_fenicsx.fem.assembly import integral, raise_on_all_ranks
from remodel_fenicsx.model.tensors import Array, Integers
from remodel_fenicsx.schema.settings import Support
from remodel_fenicsx.schema.tables import SceneError

if TYPE_CHECKING:
    from dolfinx.fem import Function
    from dolfinx.mesh import Mesh, MeshTags
    from ufl.core.expr import Expr

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshDomain(Domain):
    """Domain with the connected parts, normals and rims of its faces."""

    boundary: Boundary
    part_tags: MeshTags
    rims: list[Integers]

    def of_parts(self, face: str, name: str) -> Function:
        """Return `normal` or `centre` of a face's parts, constant on each adjacent element."""
        function = dolfinx.fem.Function(dolfinx.fem.functionspace(self.mesh, ("DG", 0, (3,))))
        dofmap = function.function_space.dofmap
        values, dofs = function.x.array.reshape(-1, 3), dofmap.list.reshape(-1)
        for part, facets in self.facets_of_parts(face):
            values[dofs[cells_of(self.mesh, facets)[0]]] = getattr(part, name)
        return function

    def facets_of_parts(self, face: str) -> list[tuple[Face, NDArray[np.int32]]]:
        """Return the parts of a face with their local facets."""
        parts = enumerate(self.boundary.faces)
        return [(part, self.part_tags.find(number)) for number, part in parts if part.name == face]

    def area(self, face: str) -> float:
        """Return the area of a named face, with plane facets."""
        return self.boundary.area(face)

    @property
    def thickness(self) -> float:
        """Mean thickness of the wall from volume and face areas; without them a cube's side."""
        volume, area = self.boundary.volume, self.area("inner") + self.area("outer")
        return 2 * volume / area if area else float(np.cbrt(volume))

    def caps(self, nodes: Array | None) -> float:
        """Return the volume of cones from the origin to flat caps on the rims. Collective.

        `nodes`: positions of all nodes in input order on rank 0, None elsewhere.
        """
        volumes = [] if nodes is None else [cap_volume(nodes, rim) for rim in self.rims]
        return float(self.comm.bcast(sum(volumes)))

    def length(self) -> float:
        """Compute the length from inlet to outlet, or 0 for a body without either. Collective."""
        # The length is the volume over the integral of |grad psi|, with psi harmonic from 0 to 1.
        # In a bend psi is proportional to the angle. The mean of |grad psi| is that on the line of
        # the sections' centres, where 1/R has its mean.
        if not {"inlet", "outlet"} <= set(self.faces):
            return 0.0
        mesh = self.mesh
        degree = int(mesh.geometry.cmap.degree)
        dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree})
        ends = self.facets("inlet"), self.facets("outlet")
        psi = harmonic(slopes(mesh, degree, dx), *ends, multigrid=degree > 1)
        slope, one = ufl.sqrt(ufl.inner(ufl.grad(psi), ufl.grad(psi))), dolfinx.fem.Constant(
            mesh, np.float64(1.0)
        )
        volume, total = (integral(jit.form(value * dx)) for value in (one, slope))
        return volume / total


def shared(
    read: Callable[[], tuple[MeshFile, Boundary, dict[str, int]]],
    comm: MPI.Intracomm,
    shape: str = "mesh",
) -> MeshDomain:
    """Distribute the mesh that rank 0 reads. Collective."""
    content = raise_on_all_ranks(comm, lambda: read() if comm.rank == 0 else None)
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")  # see `domain.build_domain`
    told = cells = groups = None
    points: Array = np.empty((0, 3))
    if content is not None:
        file, boundary, regions = content
        points, cells = file.points, file.cells[:, node_order(file)]
        groups = file.cell_groups.astype(np.int32)
        extent = float(np.ptp(points, axis=0).max())
        told = (
            file.kind,
            file.degree,
            cells[:0],
            extent,
            regions,
            boundary,
            rims_of(file, boundary),
        )
    kind, degree, none, extent, regions, boundary, lines = comm.bcast(told)
    mesh = dolfinx.mesh.create_mesh(
        comm, cells=none if cells is None else cells, x=points, e=symbolic_mesh(kind, degree)
    )
    parts = boundary.faces
    rows = np.concatenate([part.facets for part in parts])
    numbers = np.repeat(np.arange(len(parts)), [len(part.facets) for part in parts])
    of_parts = _tags_of_facets(mesh, boundary.facets[rows], numbers)
    faces = {
        name: number
        for number, name in enumerate(dict.fromkeys(part.name for part in parts), start=1)
    }
    of_faces = np.array([faces[part.name] for part in parts], dtype=np.int32)[of_parts.values]
    tags = dolfinx.mesh.meshtags(mesh, of_parts.dim, of_parts.indices, of_faces)
    more = {"boundary": boundary, "part_tags": of_parts, "rims": lines}
    domain = MeshDomain(
        mesh, tags, faces, shape, {"extent": extent}, regions, np.empty(0, np.int32), **more
    )
    return replace(domain, element_region=domain.scatter_elements(groups))


def _tags_of_facets(mesh: Mesh, corners: Integers, values: Integers) -> MeshTags:
    """Tag the facets with these corners, in rank 0's numbering of nodes. Collective."""
    dimension, here = mesh.topology.dim - 1, slice(None) if mesh.comm.rank == 0 else slice(0)
    for other in (0, dimension + 1):
        mesh.topology.create_connectivity(dimension, other)
    listed = corners[here].astype(np.int64), values[here].astype(np.int32)
    entities, tags = dolfinx.io.distribute_entity_data(mesh, dimension, *listed)
    return dolfinx.mesh.meshtags_from_entities(
        mesh, dimension, dolfinx.graph.adjacencylist(entities), tags
    )


# ---------------------------------------------------------------- supports of faces
# Default stiffness over (lambda + 2 mu) / thickness. The radii of the paper's tube are within 2e-5
# of the exact ones.
GUIDE = 1000.0
PARALLEL = 1e-3  # radians between parallel normals of a mesh in single precision
# Measured with fixed ends: with 0 there are one or two negative eigenvalues, with 0.3 and 1 none.
LEAST_TANGENTIAL = 0.5
STILL = 1e-8  # eigenvalue over the largest one, below which a rigid motion is unconstrained


def add_support(
    loading: Loading, face: str, support: Support, stiffness: float, moves: tuple[str, float] | None
) -> None:
    """Support a face; `moves` is the load that moves a 'held' or guided face, and its scale."""
    # `moves` is the name of a load, and the displacement along the normal at magnitude 1.
    if support.kind == "held":  # u = d N
        for part, facets in loading.domain.facets_of_parts(face):  # type: ignore[attr-defined]
            loading.hold_facets(facets, *((moves[0], moves[1] * part.normal) if moves else ()))
        loading.supports[face] = None
    elif support.kind != "free":
        density = _density(loading, face, support, moves)
        half, measure = loading.constant(
            (support.stiffness or stiffness) / 2
        ), loading.surface_measure(face)

        def potential(u: Function) -> ufl.Form:
            return half * density(loading.kinematics.displacement(u)) * loading.weight * measure

        loading.add_potential(potential)
        loading.supports[face] = potential


def _density(
    loading: Loading, face: str, support: Support, moves: tuple[str, float] | None
) -> Callable[[Expr], Expr]:
    """Return a function of u: the energy density of springs over half their stiffness."""
    domain: Any = loading.domain
    if support.kind == "elastic":  # (u . N)^2 + s |u - (u . N) N|^2, with the local N
        share, across = loading.constant(support.tangential), ufl.FacetNormal(domain.mesh)
        return lambda u: share * ufl.inner(u, u) + (1 - share) * ufl.inner(u, across) ** 2
    normal, way = domain.of_parts(face, "normal"), loading.magnitude(*moves) if moves else 0.0
    if support.kind == "sliding":
        return lambda u: (ufl.inner(u, normal) - way) ** 2
    around = ufl.cross(normal, ufl.SpatialCoordinate(domain.mesh) - domain.of_parts(face, "centre"))
    # With a number instead of a Constant every mesh would need a kernel of its own.
    squared = ufl.inner(around, around) + loading.constant(1e-24 * domain.size**2)
    return lambda u: (ufl.inner(u, normal) - way) ** 2 + ufl.inner(u, around) ** 2 / squared


# ---------------------------------------------------------------- rigid motions


def check_supports(domain: MeshDomain, supports: Mapping[str, Support], elongated: bool) -> None:
    """Check that no rigid motion is free, and that an elongation strains the body."""
    if free := free_motions(domain.boundary.faces, supports):
        kinds = (
            ", ".join(f"{name} {support.kind!r}" for name, support in supports.items()) or "none"
        )
        raise SceneError(f"supports ({kinds}): {free} of 6 rigid motions are unconstrained")
    sliding = [
        part
        for part in domain.boundary.faces
        if supports.get(part.name, Support(kind="free")).kind == "sliding"
    ]
    if (
        elongated
        and len(sliding) == 2
        and np.linalg.norm(np.cross(sliding[0].normal, sliding[1].normal)) > PARALLEL
    ):
        raise SceneError(
            "loads.elongation: both ends slide and are not parallel, so the elongation would only "
            "shift the body; one end must be 'guided' or 'held'"
        )
    for name, support in supports.items():
        warn_of_twist(name, support, domain.comm)


def warn_of_twist(name: str, support: Support, comm: MPI.Intracomm) -> None:
    """Warn if springs may let a growing wall twist about its axis."""
    if support.kind == "elastic" and support.tangential < LEAST_TANGENTIAL and comm.rank == 0:
        log.warning(
            "supports.%s.tangential = %g: a wall that has grown may twist, because the springs "
            "hardly resist motion across their direction; with %g or more no wall has twisted",
            name, support.tangential, LEAST_TANGENTIAL,
        )  # fmt: skip


def free_motions(parts: Sequence[Face], supports: Mapping[str, Support]) -> int:
    """Return the number of rigid motions that no support constrains."""
    everywhere = np.concatenate([part.places for part in parts])
    middle = everywhere.mean(axis=0)
    size = float(np.linalg.norm(everywhere - middle, axis=1).max())
    matrix = np.zeros((6, 6))
    for part in parts:
        support = supports.get(part.name)
        if support is not None and support.kind != "free":
            # The points are halfway between midpoint and corners, exact on triangles, so that a
            # single facet also constrains rotations. Springs along N only are taken at the
            # midpoints: around a tube they would constrain the facets, but not the round body.
            share = 0.0 if support.kind == "elastic" and not support.tangential else 0.5
            for places in np.swapaxes(
                (1 - share) * part.places[:, None] + share * part.corners, 0, 1
            ):
                # Displacements (facets, 6, 3) of unit motions along and about the axes.
                turns = np.cross(np.eye(3)[None], (places - middle)[:, None] / size)
                motions = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=1)
                held = _held_directions(support, part, places)
                matrix += np.einsum("fki,fij,flj->kl", motions, held, motions) / len(motions)
    values = np.linalg.eigvalsh(matrix)
    return int(np.sum(values <= STILL * max(float(values[-1]), 1e-300)))


def _held_directions(support: Support, part: Face, places: Array) -> Array:
    """Return a support's constraint at a position of each facet of a part, (facets, 3, 3)."""
    share = {"held": 1.0, "elastic": support.tangential}.get(support.kind, 0.0)
    normals = (
        part.normals if support.kind == "elastic" else np.broadcast_to(part.normal, places.shape)
    )
    constraint: Array = share * np.eye(3) + (1 - share) * np.einsum("fi,fj->fij", normals, normals)
    if support.kind == "guided":
        around = np.cross(part.normal, places - part.centre)
        around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-300)
        constraint += np.einsum("fi,fj->fij", around, around)
    return constraint
