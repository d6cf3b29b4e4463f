"""Solver methods by name, and options of PETSc, which is imported when it is needed: scenes are read without it."""

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
LAGGED = "lagged"  # whose factor may be of an earlier tangent (`solver.linear`)


@dataclass(frozen=True)
class SolverMethod:
    """How the nonlinear problem of a step is solved.

    Attributes
    ----------
    options
        Of PETSc, names without the leading '-'.
    meaning
        What it does, for docs/scene.md, which lists those of the package.
    linear
        The class that solves the linear systems where options do not say it all, an `EveryTangent`, or its dotted name:
        scenes are read without PETSc, which it needs.
    on_several_ranks
        Options that replace those of the same name there.

    Examples
    --------
    GMRES in place of a factorisation:

    >>> from remodel_fenicsx.extend import SOLVER_METHODS, SolverMethod
    >>> options = {"snes_type": "newtonls", "ksp_type": "gmres", "pc_type": "jacobi", "ksp_rtol": 1e-12}
    >>> SOLVER_METHODS["krylov"] = SolverMethod(options, "for small bodies")
    >>> from remodel_fenicsx import preset_scene
    >>> preset_scene("kuhl-holzapfel-2007", "cube").with_values({"solver.method": "krylov"}).solver.method
    'krylov'
    >>> del SOLVER_METHODS["krylov"]
    """

    options: Mapping[str, object]
    meaning: str = ""
    linear: Callable[..., Any] | str = "remodel_fenicsx.solver.linear.EveryTangent"
    on_several_ranks: Mapping[str, object] = field(default_factory=dict)

    @property
    def make_linear(self) -> Callable[..., Any]:
        """Makes the solver of the linear systems of an equilibrium, a SNES, a tangent and options."""
        return resolved(self.linear)


NEWTON = {"snes_type": "newtonls", "snes_linesearch_type": "basic"}
BY_MUMPS = {
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
}
ON_ONE_RANK = {
    "pc_type": "telescope",
    "telescope_ksp_type": "preonly",
    "telescope_pc_type": "lu",
    "telescope_pc_factor_mat_solver_type": "mumps",
}
SOLVER_METHODS = {
    # MUMPS: robust for indefinite tangents too, one factorisation pattern for all steps. On several ranks it adds up in
    # the order in which messages come: its last digits differ from run to run. So one rank has the whole matrix and
    # factorises it, which for the sizes that are factorised at all costs little
    "direct": SolverMethod(
        NEWTON | {"ksp_type": "preonly", **BY_MUMPS},
        "Newton's method; MUMPS factorises each system, and runs repeat to the last digit",
        on_several_ranks=ON_ONE_RANK,
    ),
    LAGGED: SolverMethod(
        NEWTON | {"ksp_type": "preonly"},
        "few factorisations, and quasi-Newton steps (L-BFGS)",
        linear="remodel_fenicsx.solver.linear.Lagged",
    ),
    # GMRES, because tangents of random cells are not always definite; levels cost as much as 20 of its iterations, and
    # those of an older tangent serve as well
    "iterative": SolverMethod(
        NEWTON
        | {
            "snes_lag_preconditioner": 20,
            "snes_lag_preconditioner_persists": True,
            "ksp_type": "gmres",
            "ksp_gmres_restart": 100,
            "ksp_rtol": 1e-3,
            "ksp_max_it": 300,
            "pc_type": "gamg",
            "pc_gamg_threshold": 0.01,
            "pc_gamg_reuse_interpolation": True,
            "mg_levels_ksp_type": "chebyshev",
            "mg_levels_pc_type": "sor",
        },
        "Newton's method with GMRES and algebraic multigrid (GAMG)",
        linear="remodel_fenicsx.solver.linear.Multigrid",
    ),
}

REMOVED = {"exact": "was removed; take 'lagged', or 'direct' for a new tangent in every iteration"}
"""Methods of earlier versions, and what to take in their place."""

# Factors that are kept, by what is known of the tangent, the best first; each but the last may be refused
DEFINITE, SYMMETRIC, GENERAL = "positive definite", "symmetric", "general"  # by CHOLMOD; by MUMPS
FACTOR_OPTIONS: dict[str, Mapping[str, object]] = {
    DEFINITE: {
        "pc_type": "cholesky",
        "pc_factor_mat_solver_type": "cholmod",
        "mat_cholmod_factor": "SUPERNODAL",
        "mat_cholmod_print": 0,
    },
    SYMMETRIC: {
        "pc_type": "cholesky",
        "pc_factor_mat_solver_type": "mumps",
        "mat_mumps_icntl_7": 3,  # SCOTCH, as fast as any; PORD ends the process for some small matrices
    },
    GENERAL: SOLVER_METHODS["direct"].options,
}

# Unknowns up to which PETSc's own LU of every tangent is the fastest on one rank. A reduction has narrow bands: above
# 2,000 unknowns MUMPS is faster. A body in three dimensions fills its factors: `lagged` takes as long at about 200
# unknowns, 0.6 of it at 380, 0.4 at 650 and 0.25 at 1,500 (cubes and tubes of random cells, 40 steps).
SMALL_REDUCTION, SMALL_BODY = 2000, 200
LARGE = 100_000  # unknowns from which on even a few factors cost more than multigrid, in time and in memory
WORTH_RANKS = 5_000  # unknowns below which a second rank costs more than it brings


def is_small(unknowns: int, reduced: bool) -> bool:
    """Whether a reduction, or a body in three dimensions, is best factorised by PETSc itself."""
    return unknowns <= (SMALL_REDUCTION if reduced else SMALL_BODY)


def chosen(method: str, unknowns: int, reduced: bool, multigrid: bool = True) -> str:
    """The method that `auto` stands for."""
    if method != AUTO:
        return method
    if multigrid and unknowns > LARGE:
        return "iterative"
    return "direct" if is_small(unknowns, reduced) else LAGGED


def method_options(method: str, ranks: int, small: bool = False) -> dict[str, object]:
    """PETSc options of a method on so many ranks; `small`: for a problem that `is_small`, on one rank."""
    options = dict(SOLVER_METHODS[method].options)
    if small and ranks == 1 and options.get("pc_factor_mat_solver_type") == "mumps":
        options["pc_factor_mat_solver_type"] = "petsc"
    if ranks > 1:
        options |= SOLVER_METHODS[method].on_several_ranks
        if options.get("pc_type") == "telescope":
            options["pc_telescope_reduction_factor"] = ranks
    return options


def multigrid_options() -> dict[str, object]:
    """PETSc options of the preconditioner of `iterative`."""
    return {name: value for name, value in SOLVER_METHODS["iterative"].options.items() if name[:2] in ("pc", "mg")}


def factor_options(kind: str) -> dict[str, object]:
    """PETSc options of a preconditioner that factorises on one rank, a key of `FACTOR_OPTIONS`."""
    return {name: value for name, value in FACTOR_OPTIONS[kind].items() if name.startswith(("pc_", "mat_"))}


# ---------------------------------------------------------------- options that a scene may give
# A scene is passed around: it may choose how systems are solved, never run code nor write files.
_SOLVERS = re.compile(
    r"(?:\w+_)??(?:snes|ksp|pc|mat)_\w+"
)  # also those of a solver's inner solvers: mg_levels_ksp_type
_CODE = re.compile(r"python|shell", re.IGNORECASE)
_PLAIN = re.compile(r"[A-Za-z0-9_.,+-]*")  # names, numbers and lists of them: no path, no "ascii:FILE"
# PETSc's PetscViewerType: as the end of a value of any monitor or view each opens a file, a socket or a window
_VIEWERS = tuple(
    "adios ascii binary cgns draw exodusii glvis hdf5 mathematica matlab pyvista saws socket string vtk vu".split()
)
# of MUMPS: units of its messages (each a file fort.N but for 0 and 6, which it has), factors kept on the disk
_MUMPS_FILES = re.compile(r"mat_mumps_(?:icntl_(?:1|2|3|22)|ooc_\w+)$", re.IGNORECASE)
_FILES = re.compile(r"_(?:dump|save|file)(?:_|$)", re.IGNORECASE)
_FILE_OR_TERMINAL = re.compile(r"_print_subdomains$", re.IGNORECASE)  # a value is the name of a file


def fault_of_option(name: str, value: str | float | bool) -> str | None:
    """Why a scene may not give this PETSc option; None where it may."""
    words = re.split(r"[,.]", value.lower()) if isinstance(value, str) else []
    if not _SOLVERS.fullmatch(name):
        return "not an option of a solver; allowed are snes_..., ksp_..., pc_... and mat_..."
    if _CODE.search(name) or any(map(_CODE.search, words)):
        return "would run code of its own; allowed are PETSc's compiled solvers"
    if _MUMPS_FILES.search(name) or _FILES.search(name) or (_FILE_OR_TERMINAL.search(name) and value is not True):
        return "would write files; allowed are options that write none"
    if isinstance(value, str) and (not _PLAIN.fullmatch(value) or any(word.endswith(_VIEWERS) for word in words)):
        return "names a file or a viewer; allowed are names, numbers, true (then PETSc prints) and false"
    return None


# ---------------------------------------------------------------- options of one problem in PETSc's database
# The method's, the scene's over them, the user's own `-remodel_...` over both. Every problem has a prefix of its own:
# two problems of one process never see each other's options.
USERS_PREFIX = "remodel_"

_numbers = itertools.count(1)


class ProblemOptions:
    """The options of one problem in PETSc's database, from its making to `close`."""

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
            self._database.hasName(self.prefix + key)  # asked for: PETSc does not call it left over

    def apply(self, snes: PETSc.SNES) -> None:
        """Give them to SNES, or to another of PETSc's solvers."""
        snes.setOptionsPrefix(self.prefix)
        try:
            snes.setFromOptions()
        except self._petsc.Error as error:
            self.close()
            given = ", ".join(f"{key} = {value!r}" for key, value in self._given.items())
            raise SceneError(
                f"solver.petsc_options: {given or 'those of PETSC_OPTIONS'}: PETSc refuses them (error {error.ierr}); "
                "allowed are the options of its manual pages"
            ) from error

    @property
    def given(self) -> set[str]:
        """Names of those that are not the method's."""
        return {*self._given, *self._users_options()}

    def unused(self) -> list[str]:
        """The scene's and the user's options that PETSc has not asked for: misspelt, or without effect so far."""
        return sorted(key for key in self._names & self.given if not self._was_used(self.prefix + key))

    def close(self) -> None:
        """Take them out of PETSc's database."""
        for key in self._names:
            self._database.delValue(self.prefix + key)
        self._names.clear()

    def _users_options(self) -> dict[str, str]:
        """What the command line or PETSC_OPTIONS say under `remodel_`, without it; problems' own prefixes aside."""
        found = {}
        for name, value in self._database.getAll().items():
            key = name.removeprefix(USERS_PREFIX)
            if key != name and not key[:1].isdigit():
                self._database.hasName(name)  # asked for: PETSc does not call it left over
                found[key] = value
        return found

    def _was_used(self, name: str) -> bool:
        answer = ctypes.c_int(0)  # the one question that petsc4py cannot ask
        ctypes.CDLL(self._petsc.__file__).PetscOptionsUsed(None, name.encode(), ctypes.byref(answer))
        return bool(answer.value)
