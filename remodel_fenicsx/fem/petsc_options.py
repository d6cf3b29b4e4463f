"""PETSc options of one problem: the method's, the scene's over them, the user's own `-remodel_...` over both.

Every problem has a prefix of its own, so that two problems of one process never see each other's options.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Mapping
from typing import Any

from petsc4py import PETSc

from remodel_fenicsx.schema.tables import SceneError

USERS_PREFIX = "remodel_"

_numbers = itertools.count(1)
_petsc = ctypes.CDLL(PETSc.__file__)  # for the one question that petsc4py cannot ask


class ProblemOptions:
    """The options of one problem in PETSc's database, from its making to `close`."""

    def __init__(self, own: Mapping[str, Any], options: Mapping[str, Any]):
        self.prefix = f"{USERS_PREFIX}{next(_numbers)}_"
        self._given = dict(options)
        self._names: set[str] = set()
        for key, value in {**own, **options, **_users_options()}.items():
            if value is not False:
                PETSc.Options().setValue(self.prefix + key, None if value is True else value)
                self._names.add(key)
        for key in own.keys() - options.keys():
            PETSc.Options().hasName(self.prefix + key)  # asked for: PETSc does not call it left over

    @property
    def given(self) -> set[str]:
        """Names of those that are not the method's."""
        return {*self._given, *_users_options()}

    def apply(self, snes: Any) -> None:
        """Give them to SNES, or to another of PETSc's solvers."""
        snes.setOptionsPrefix(self.prefix)
        try:
            snes.setFromOptions()
        except PETSc.Error as error:
            self.close()
            given = ", ".join(f"{key} = {value!r}" for key, value in self._given.items())
            raise SceneError(
                f"solver.petsc_options: {given or 'those of PETSC_OPTIONS'}: PETSc refuses them (error {error.ierr}); "
                "allowed are the options of its manual pages"
            ) from error

    def unused(self) -> list[str]:
        """The scene's and the user's options that PETSc has not asked for: misspelt, or without effect so far."""
        return sorted(key for key in self._names & self.given if not _was_used(self.prefix + key))

    def close(self) -> None:
        """Take them out of PETSc's database."""
        for key in self._names:
            PETSc.Options().delValue(self.prefix + key)
        self._names.clear()


def _users_options() -> dict[str, str]:
    """What the command line or PETSC_OPTIONS say under `remodel_`, without it; problems' own prefixes aside."""
    found = {}
    for name, value in PETSc.Options().getAll().items():
        key = name.removeprefix(USERS_PREFIX)
        if key != name and not key[:1].isdigit():
            PETSc.Options().hasName(name)  # asked for: PETSc does not call it left over
            found[key] = value
    return found


def _was_used(name: str) -> bool:
    answer = ctypes.c_int(0)
    _petsc.PetscOptionsUsed(None, name.encode(), ctypes.byref(answer))
    return bool(answer.value)
