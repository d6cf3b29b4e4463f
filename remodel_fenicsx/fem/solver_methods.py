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
