"""Solver methods by name: PETSc options of each. A leaf without PETSc, so that scenes can be checked anywhere."""

from __future__ import annotations

from typing import Any

# MUMPS: robust for indefinite tangents too, one factorisation pattern for all steps
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

# MUMPS on several ranks adds up in the order in which messages come: its last digits differ from run to run. So one
# rank has the whole matrix and factorises it, which for the sizes that are factorised at all costs little
ON_SEVERAL_RANKS: dict[str, dict[str, Any]] = {
    "direct": {
        "pc_type": "telescope",
        "telescope_ksp_type": "preonly",
        "telescope_pc_type": "lu",
        "telescope_pc_factor_mat_solver_type": "mumps",
    },
}


SMALL = 2000  # unknowns up to which MUMPS costs more than all the rest of a problem: then PETSc factorises by itself


def method_options(method: str, ranks: int, small: bool = False) -> dict[str, Any]:
    """PETSc options of a method on so many ranks; `small`: for a problem of up to `SMALL` unknowns, on one rank."""
    options = dict(METHODS[method])
    if small and ranks == 1 and options.get("pc_factor_mat_solver_type") == "mumps":
        options |= {"pc_factor_mat_solver_type": "petsc", "mat_mumps_icntl_33": False}
    if ranks > 1:
        options |= ON_SEVERAL_RANKS.get(method, {})
        if options.get("pc_type") == "telescope":
            options["pc_telescope_reduction_factor"] = ranks
    return options
