"""Solver methods by name: PETSc options of each. A leaf without PETSc, so that scenes can be checked anywhere."""

from __future__ import annotations

from typing import Any

# MUMPS: robust for indefinite tangents too, one factorisation pattern for all steps, any number of ranks
METHODS: dict[str, dict[str, Any]] = {
    "direct": {
        "snes_type": "newtonls",
        "snes_linesearch_type": "basic",
        "ksp_type": "preonly",
        "pc_type": "lu",
        "pc_factor_mat_solver_type": "mumps",
        "mat_mumps_icntl_33": 1,  # the determinant, whose sign tells of unstable equilibria; costs nothing
    },
}

SMALL = 2000  # unknowns up to which MUMPS costs more than all the rest of a reduced problem


def suited_options(method: str, reduced: bool, unknowns: int, ranks: int) -> dict[str, Any]:
    """What a small problem on one rank needs other than its method says: PETSc's own factorisation.

    Problems in three dimensions stay with the method's, so that their numbers do not depend on their size.
    """
    if not (reduced and ranks == 1 and unknowns <= SMALL):
        return {}
    if METHODS[method].get("pc_factor_mat_solver_type") != "mumps":
        return {}
    return {"pc_factor_mat_solver_type": "petsc", "mat_mumps_icntl_33": False}
