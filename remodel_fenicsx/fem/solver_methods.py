"""Solver methods by name, and PETSc options."""

# PETSc is imported when it is needed: scenes are read without it.

from __future__ import annotations

import ctypes
import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TYPE_CHECKING

from remodel_fenicsx._lazy import resolved
from remodel_fenicsx.schema.tables import SceneError

if TYPE_CHECKING:
    from petsc4py import PETSc

AUTO = "auto"
LAGGED = "lagged"  # method whose factorisation may be of an earlier tangent (`solver.linear`)


@dataclass(frozen=True)
class SolverMethod:
    """Method for the nonlinear problem of a step.

    Attributes
    ----------
    options
        PETSc options, names without the leading '-'.
    meaning
        Description for docs/scene.md, which lists the methods of the package.
    linear
        Class that solves the linear systems, an `FullNewton`, or its dotted name. Scenes are read
        without PETSc, which the class needs.
    on_several_ranks
        Options that replace those of the same name on several ranks.

    Examples
    --------
    GMRES in place of a factorisation:

    >>> from remodel_fenicsx.extend import SOLVER_METHODS, SolverMethod
    >>> options = {"snes_type": "newtonls", "ksp_type": "gmres", "pc_type": "jacobi"}
    >>> SOLVER_METHODS["krylov"] = SolverMethod(options | {"ksp_rtol": 1e-12}, "for small bodies")
    >>> from remodel_fenicsx import preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube")
    >>> scene.with_values({"solver.method": "krylov"}).solver.method
    'krylov'
    >>> del SOLVER_METHODS["krylov"]
    """

    options: Mapping[str, object]
    meaning: str = ""
    linear: Callable[..., Any] | str = "remodel_fenicsx.solver.linear.FullNewton"
    on_several_ranks: Mapping[str, object] = field(default_factory=dict)

    @property
    def make_linear(self) -> Callable[..., Any]:
        """Constructor of the linear solver, from an equilibrium, a SNES, a tangent and options."""
        return resolved(self.linear)


NEWTON = {"snes_type": "newtonls", "snes_linesearch_type": "basic"}
MUMPS_LU: dict[str, object] = {
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
}


def gathered(factor: Mapping[str, object]) -> dict[str, object]:
    """Return the PETSc options of a factorisation by the first of several ranks."""
    options = {f"telescope_{name}": value for name, value in factor.items()}
    return {"pc_type": "telescope", "telescope_ksp_type": "preonly", **options}


SOLVER_METHODS = {
    # MUMPS is robust for indefinite tangents too, and analyses the pattern once for all steps. On
    # several ranks it sums in the order in which messages arrive, so that its last digits differ
    # from run to run. Therefore one rank has the whole matrix and factorises it, which costs little
    # for the sizes that are factorised at all.
    "direct": SolverMethod(
        NEWTON | {"ksp_type": "preonly", **MUMPS_LU},
        "Newton's method; MUMPS factorises each system, and runs repeat to the last digit",
        on_several_ranks=gathered(MUMPS_LU),
    ),
    LAGGED: SolverMethod(
        NEWTON | {"ksp_type": "preonly"},
        "few factorisations, and quasi-Newton steps (L-BFGS)",
        linear="remodel_fenicsx.solver.linear.Lagged",
    ),
    # GMRES, because tangents of random cells are not always definite. The options of `pc` are for
    # degree 1; from degree 2 on see `PMultigrid`.
    "iterative": SolverMethod(
        NEWTON
        | {
            "ksp_type": "gmres",
            "ksp_gmres_restart": 100,
            "ksp_rtol": 1e-3,
            "ksp_max_it": 100,
            "pc_type": "gamg",
            "pc_gamg_threshold": 0.01,
            "pc_gamg_reuse_interpolation": True,
            "mg_levels_ksp_type": "chebyshev",
            "mg_levels_pc_type": "sor",
        },
        "Newton's method with GMRES and multigrid",
        linear="remodel_fenicsx.solver.linear.Multigrid",
    ),
}

REMOVED = {"exact": "was removed; use 'lagged', or 'direct' for a new tangent in every iteration"}
"""Methods of earlier versions, and their replacements."""

# Lagged factorisations, the fastest first. Each but the last requires properties of the tangent and
# may fail.
# By CHOLMOD, and by MUMPS.
DEFINITE, SYMMETRIC = "Cholesky factorisation", "LDL^T factorisation"
GENERAL = "LU factorisation"
FACTOR_OPTIONS: dict[str, dict[str, object]] = {
    DEFINITE: {
        "pc_type": "cholesky",
        "pc_factor_mat_solver_type": "cholmod",
        "mat_cholmod_factor": "SUPERNODAL",
        "mat_cholmod_print": 0,
    },
    SYMMETRIC: {
        "pc_type": "cholesky",
        "pc_factor_mat_solver_type": "mumps",
        # SCOTCH is as fast as any; PORD kills the process for some small matrices.
        "mat_mumps_icntl_7": 3,
    },
    GENERAL: MUMPS_LU,
}

# Unknowns up to which PETSc's own LU of every tangent is the fastest on one rank. The matrix of a
# reduction has a small bandwidth: MUMPS is faster above 2,000 unknowns. A body in three dimensions
# has much fill-in: `lagged` takes as long at about 200 unknowns, 0.6 of the time at 380, 0.4 at 650
# and 0.25 at 1,500 (cubes and tubes of random cells, 40 steps).
MAX_DIRECT_REDUCED, MAX_DIRECT_3D = 2000, 200
MIN_MULTIGRID = 100_000  # unknowns above which even a few factorisations cost more than multigrid


def is_small(unknowns: int, reduced: bool) -> bool:
    """Return whether PETSc's own LU is the fastest for a reduction, or for a body in 3D."""
    return unknowns <= (MAX_DIRECT_REDUCED if reduced else MAX_DIRECT_3D)


def resolve_auto(method: str, unknowns: int, reduced: bool, multigrid: bool = True) -> str:
    """Return the method, with `auto` resolved by the number of unknowns."""
    if method != AUTO:
        return method
    if multigrid and unknowns > MIN_MULTIGRID:
        return "iterative"
    return "direct" if is_small(unknowns, reduced) else LAGGED


def method_options(method: str, ranks: int, small: bool) -> dict[str, object]:
    """Return PETSc options of a method; `small`: for a problem that `is_small`, on one rank."""
    options = dict(SOLVER_METHODS[method].options)
    if small and ranks == 1 and options.get("pc_factor_mat_solver_type") == "mumps":
        options["pc_factor_mat_solver_type"] = "petsc"
    if ranks > 1:
        options |= SOLVER_METHODS[method].on_several_ranks
        if options.get("pc_type") == "telescope":
            options["pc_telescope_reduction_factor"] = ranks
    return options


def levels_options(ranks: int) -> dict[str, object]:
    """Return the PETSc options of two levels, of which the lower one is factorised."""
    # On a thin wall GAMG instead of the factor takes 1.5 times as many iterations. LU, because the
    # tangent of a pressure on an open face and that of an unloaded body are not symmetric.
    factor: Mapping[str, object] = MUMPS_LU
    if ranks > 1:
        factor = gathered(factor) | {"pc_telescope_reduction_factor": ranks}
    return {
        "pc_type": "mg",
        "pc_mg_levels": 2,
        # Smoothed after the correction alone: one polynomial of degree 12 reduces more than two of
        # degree 5. Its interval reaches down to what elements of degree 1 miss where a wall is thin
        # or its bulk is stiff; degrees 7 to 15 take about as many products in a stout wall.
        "pc_mg_type": "kaskade",
        "mg_levels_ksp_type": "chebyshev",
        "mg_levels_ksp_max_it": 12,
        "mg_levels_ksp_chebyshev_esteig": "0,0.015,0,1.1",
        "mg_levels_pc_type": "pbjacobi",
        **{f"mg_coarse_{name}": value for name, value in factor.items()},
    }


# ---------------------------------------------------------------- PETSc options in scenes
# Scenes are exchanged: they may select how systems are solved, but never run code or write files.
# Also of inner solvers, such as mg_levels_ksp_type.
_SOLVERS = re.compile(r"(?:\w+_)??(?:snes|ksp|pc|mat)_\w+")
_CODE = re.compile(r"python|shell", re.IGNORECASE)
# Names, numbers and lists of them: no path, no "ascii:FILE".
_PLAIN = re.compile(r"[A-Za-z0-9_.,+-]*")
# PETSc's PetscViewerType. At the end of a value of a monitor or view each opens a file, a socket or
# a window.
_VIEWERS = tuple(
    "adios ascii binary cgns draw exodusii glvis hdf5 "
    "mathematica matlab pyvista saws socket string vtk vu".split()
)
# Options of MUMPS: units of its messages (each opens a file fort.N except 0 and 6), and factors
# stored on the disk.
_MUMPS_FILES = re.compile(r"mat_mumps_(?:icntl_(?:1|2|3|22)|ooc_\w+)$", re.IGNORECASE)
_FILES = re.compile(r"_(?:dump|save|file)(?:_|$)", re.IGNORECASE)
# A value other than true is a file name.
_FILE_OR_TERMINAL = re.compile(r"_print_subdomains$", re.IGNORECASE)


def option_problem(name: str, value: str | float | bool) -> str | None:
    """Return why a scene may not set this PETSc option; None if it may."""
    words = re.split(r"[,.]", value.lower()) if isinstance(value, str) else []
    if not _SOLVERS.fullmatch(name):
        return "not an option of a solver; allowed: snes_..., ksp_..., pc_..., mat_..."
    if _CODE.search(name) or any(map(_CODE.search, words)):
        return "would run custom code; allowed: PETSc's compiled solvers"
    if (
        _MUMPS_FILES.search(name)
        or _FILES.search(name)
        or (_FILE_OR_TERMINAL.search(name) and value is not True)
    ):
        return "would write files; allowed: options that write no files"
    if isinstance(value, str) and (
        not _PLAIN.fullmatch(value) or any(word.endswith(_VIEWERS) for word in words)
    ):
        return "names a file or a viewer; allowed: names, numbers, true (PETSc then prints), false"
    return None


# ---------------------------------------------------------------- options of one problem
# Options of the scene override those of the method, and the user's `-remodel_...` override both.
# Every problem has its own prefix, so that two problems of one process never see each other's
# options.
USERS_PREFIX = "remodel_"

_numbers = itertools.count(1)


class ProblemOptions:
    """Options of one problem in PETSc's database, from construction to `close`."""

    def __init__(self, own: Mapping[str, object], options: Mapping[str, object]):
        from petsc4py import PETSc

        self.prefix, self._given = f"{USERS_PREFIX}{next(_numbers)}_", dict(options)
        self._petsc, self._database = PETSc, PETSc.Options()
        self._names: set[str] = set()
        for key, value in {**own, **options, **self._users_options()}.items():
            if value is not False:
                self._database.setValue(self.prefix + key, None if value is True else value)
                self._names.add(key)
        for key in own.keys() - options.keys():
            # Marks it as used: PETSc does not report it as left over.
            self._database.hasName(self.prefix + key)

    def apply(self, snes: PETSc.SNES) -> None:
        """Set the options of SNES, or of another PETSc solver."""
        snes.setOptionsPrefix(self.prefix)
        try:
            snes.setFromOptions()
        except self._petsc.Error as error:
            self.close()
            given = ", ".join(f"{key} = {value!r}" for key, value in self._given.items())
            raise SceneError(
                f"solver.petsc_options: {given or 'those of PETSC_OPTIONS'}: "
                f"PETSc rejects them (error {error.ierr}); PETSc's manual pages list all options"
            ) from error

    @property
    def given(self) -> set[str]:
        """Names of the scene's and the user's options."""
        return {*self._given, *self._users_options()}

    def unused(self) -> list[str]:
        """Return the scene's and the user's options without effect so far, perhaps misspelt."""
        return sorted(
            key for key in self._names & self.given if not self._was_used(self.prefix + key)
        )

    def close(self) -> None:
        """Remove the options from PETSc's database."""
        for key in self._names:
            self._database.delValue(self.prefix + key)
        self._names.clear()

    def _users_options(self) -> dict[str, str]:
        """Return the options `remodel_...` of command line and PETSC_OPTIONS, without prefix."""
        options = {}
        for name, value in self._database.getAll().items():
            key = name.removeprefix(USERS_PREFIX)
            if key != name and not key[:1].isdigit():
                # Marks it as used: PETSc does not report it as left over.
                self._database.hasName(name)
                options[key] = value
        return options

    def _was_used(self, name: str) -> bool:
        answer = ctypes.c_int(0)  # petsc4py lacks this function
        ctypes.CDLL(self._petsc.__file__).PetscOptionsUsed(
            None, name.encode(), ctypes.byref(answer)
        )
        return bool(answer.value)
