"""Matrices of bilinear forms: on one rank dolfinx writes into the memory that PETSc reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.la
from petsc4py import PETSc

SHARED = "dolfinx"  # attribute of a PETSc matrix: dolfinx's own, with the same numbers


def create_matrix(form: Any) -> Any:
    """An empty PETSc matrix with the pattern of a compiled bilinear form. Collective.

    On one rank its rows are those of a `dolfinx.la.MatrixCSR`: then no value goes through PETSc's insertion, which
    takes as long as the kernels.
    """
    if form.mesh.comm.size > 1:
        return dolfinx.fem.petsc.create_matrix(form)
    shared = dolfinx.fem.create_matrix(form, dolfinx.la.BlockMode.expanded)
    rows = shared.indptr.astype(PETSc.IntType), shared.indices.astype(PETSc.IntType, copy=False), shared.data
    size, block = len(rows[0]) - 1, form.function_spaces[0].dofmap.index_map_bs
    matrix = PETSc.Mat().createAIJWithArrays((size, size), rows, comm=form.mesh.comm)
    matrix.setBlockSizes(block, block)  # for multigrid
    matrix.setAttr(SHARED, shared)
    return matrix


def assemble_matrix(matrix: Any, forms: Sequence[Any], conditions: Sequence[Any]) -> None:
    """The sum of compiled bilinear forms; zero in the rows and columns of conditions, one on their diagonal."""
    matrix.zeroEntries()
    target: Any = matrix.getAttr(SHARED)
    assemble: Any = dolfinx.fem.assemble_matrix  # mypy sees one overload of a single-dispatch function
    if target is None:
        target, assemble = matrix, dolfinx.fem.petsc.assemble_matrix
    for form in forms:
        assemble(target, form, bcs=list(conditions))
        matrix.assemble()
