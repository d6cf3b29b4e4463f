"""What the tests compare between numbers of ranks: mpirun -n 2 python3 -m mpi4py tests/parallel_parts.py."""

from __future__ import annotations

import hashlib
import json

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body import GeometryError, domain
from remodel_fenicsx.schema.settings import Mesh, Region
from tests import parts

LAYERED = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
LAYERS = {"media": Region(outer_radius=1.4), "adventitia": Region()}


def digest(domain):
    """Digest of the gathered mesh, of cell and node values drawn locally by number, and of the named faces' sizes."""
    points, cells = domain.gather_mesh()
    table = np.random.default_rng(1).random((max(domain.number_of_elements, domain.number_of_nodes), 3))
    values = domain.gather_elements(table[domain.element_number]), domain.gather_nodes(table[domain.node_number])
    pieces = [points, cells, *values, domain.gather_elements(domain.element_region)]
    facets = domain.mesh.topology.index_map(2)
    sizes = [
        domain.comm.allreduce(int(np.sum(domain.facet_tags.find(tag) < facets.size_local)))
        for tag in domain.faces.values()
    ]
    if domain.comm.rank != 0:
        return None
    gathered = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in pieces)).hexdigest()
    return [gathered, dict(zip(domain.faces, sizes, strict=True))]


def digests(comm):
    """Digests of all shapes; the cube of one element leaves a rank without a cell."""
    return {
        "cube": digest(parts.cube(comm=comm)),
        "tendon": digest(parts.tendon(comm=comm)),
        "tendon of tetrahedra": digest(parts.tendon(element="tetrahedron", comm=comm)),
        "tube": digest(parts.tube(comm=comm)),
        "tube of degree 2": digest(parts.tube(degree=2, divisions=(16, 3, 2), comm=comm)),
        "tube of two layers": digest(LAYERED.build_with(LAYERS, Mesh(), comm)),
    }


def failures(comm):
    """What every rank says when drawing fails on rank 0."""

    def broken():
        raise OSError("no more ink")

    said = []
    for draw in (broken, lambda: None):
        try:
            domain.build_domain(draw, "cube", {"side": 1.0}, comm)
        except GeometryError as error:
            said.append(str(error))
    return comm.gather(said, root=0)


if __name__ == "__main__":
    world = MPI.COMM_WORLD
    result = {"ranks": world.size, "digests": digests(world), "failures": failures(world)}
    if world.rank == 0:
        print(json.dumps(result))
