"""Meshes of one's own, split or with elements of degree 2: Gmsh does it with the arrays of a file that was read."""

from __future__ import annotations

import numpy as np

from remodel_fenicsx.body.gmsh_model import gmsh_model
from remodel_fenicsx.body.mesh_file import BY_NUMBER, Block, MeshFile, MeshFileError, assembled, distinct

GMSH_TYPES = {("tetrahedron", 1): (4, 2), ("hexahedron", 1): (5, 3)}  # of elements and facets


def refined(file: MeshFile, refinement: int, degree: int) -> MeshFile:
    """A mesh of plane elements, split into halves along each edge, as often as asked for."""
    if (refinement, degree) == (1, file.degree):
        return file
    if file.degree != 1:
        raise MeshFileError(f"has elements of degree {file.degree}: they are taken as they are")
    solid, flat = GMSH_TYPES[file.kind, 1]
    with gmsh_model("file") as gmsh:
        numbers = {3: distinct(file.cell_groups), 2: distinct(file.facet_groups)}
        entities = {d: {n: gmsh.model.addDiscreteEntity(d) for n in found} for d, found in numbers.items()}
        first = next(iter(entities[3].values()))
        gmsh.model.mesh.addNodes(3, first, np.arange(1, len(file.points) + 1), file.points.reshape(-1))
        parts = {3: (solid, file.cells, file.cell_groups), 2: (flat, file.facets, file.facet_groups)}
        for dimension, (kind, rows, groups) in parts.items():
            for number, entity in entities[dimension].items():
                gmsh.model.mesh.addElementsByType(entity, kind, [], 1 + rows[groups == number].reshape(-1))
        for _ in range(refinement.bit_length() - 1):
            gmsh.model.mesh.refine()
        if degree == 2:
            before = gmsh.option.getNumber("Mesh.SecondOrderLinear")
            gmsh.option.setNumber("Mesh.SecondOrderLinear", 1)
            gmsh.model.mesh.setOrder(2)
            gmsh.option.setNumber("Mesh.SecondOrderLinear", before)
        tags, places, _ = gmsh.model.mesh.getNodes()
        blocks = []
        for dimension, by_number in entities.items():
            for number, entity in by_number.items():
                for kind, elements, nodes in zip(*gmsh.model.mesh.getElements(dimension, entity), strict=True):
                    rows = np.asarray(nodes, dtype=np.int64).reshape(len(elements), -1)
                    groups = np.full(len(elements), number, dtype=np.int64)
                    blocks.append(Block(BY_NUMBER[int(kind)], np.asarray(elements), groups, rows))
    order = np.argsort(tags)
    points = np.asarray(places, dtype=np.float64).reshape(-1, 3)[order]
    return assembled(np.asarray(tags, dtype=np.int64)[order], points, blocks, file.names, file.data)
