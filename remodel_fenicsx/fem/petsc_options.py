"""Solver profiles: PETSc options by name, and the user's own on top."""

from __future__ import annotations

import ctypes
from typing import Any

from petsc4py import PETSc

from remodel_fenicsx.scene.scene import SceneError, Solver

OPTIONS_PREFIX = "remodel_"

# MUMPS: robust for indefinite tangents too, one factorisation pattern for all steps, any number of ranks
PROFILES: dict[str, dict[str, Any]] = {
    "direct": {
        "snes_type": "newtonls",
        "snes_linesearch_type": "basic",
        "ksp_type": "preonly",
        "pc_type": "lu",
        "pc_factor_mat_solver_type": "mumps",
    },
}


_set_here: set[str] = set()
_petsc = ctypes.CDLL(PETSc.__file__)  # for the one question that petsc4py cannot ask


def set_options(snes: Any, settings: Solver) -> None:
    """Give SNES the profile's options, then the scene's, under those of the command line or PETSC_OPTIONS.

    All carry the prefix `remodel_`: for instance ``PETSC_OPTIONS="-remodel_snes_monitor"``. They stay in PETSc's
    database because the factorisation reads its own at the first solve.
    """
    database = PETSc.Options()
    _forget(set(_set_here))
    for key, value in {**PROFILES[settings.profile], **settings.petsc_options}.items():
        name = OPTIONS_PREFIX + key
        if database.hasName(name) or value is False:
            continue
        database.setValue(name, None if value is True else value)
        _set_here.add(name)
    snes.setOptionsPrefix(OPTIONS_PREFIX)
    try:
        snes.setFromOptions()
    except PETSc.Error as error:
        _forget(set(_set_here))
        given = ", ".join(f"{key} = {value!r}" for key, value in settings.petsc_options.items())
        raise SceneError(
            f"solver.petsc_options: {given or 'those of PETSC_OPTIONS'}: PETSc refuses them (error {error.ierr}); "
            "allowed are the options of its manual pages"
        ) from error


def unused_options(settings: Solver) -> list[str]:
    """The scene's options that PETSc has not asked for by the end of the first solve: misspelt, or without effect.

    They, and those of the profile that the scene's made needless, are taken out of PETSc's database.
    """
    unused = {name for name in _set_here if not _was_used(name)}
    _forget(unused)
    return sorted(key for key in settings.petsc_options if OPTIONS_PREFIX + key in unused)


def _forget(names: set[str]) -> None:
    for name in names:
        PETSc.Options().delValue(name)
    _set_here.difference_update(names)


def _was_used(name: str) -> bool:
    answer = ctypes.c_int(0)
    _petsc.PetscOptionsUsed(None, name.encode(), ctypes.byref(answer))
    return bool(answer.value)
