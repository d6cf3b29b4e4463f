"""Equilibrium between the cells of two steps: how a remodeling increment that is too large is applied in parts."""

from __future__ import annotations

from typing import Any

import dolfinx.fem
import numpy as np
from petsc4py import PETSc

from remodel_fenicsx.model.cells import UnitCell
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.settings import Solver
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton
from remodel_fenicsx.state.state import State

KEPT_RESERVE = 0.2  # share of 1 - r/L that a part of a remodeling increment leaves at every point


class Blend:
    """Equilibrium with (1 - theta) old + theta new cells in r^2 and in W_rep: the old and the new model at the ends.

    Old are the cells with which the unknowns are in equilibrium, new the state's present ones. Everything is compiled
    at once; PETSc's objects are made when they are first needed.
    """

    def __init__(self, state: State, tissue: Tissue, settings: Solver):
        self.settings = settings
        self.theta = dolfinx.fem.Constant(state.cells.quadrature.mesh, PETSc.ScalarType(0.0))
        old, new = state.equilibrium_cells, state.cells

        def at_points() -> list[UnitCell]:
            return shares(old.point_cells, new.point_cells, float(np.real(self.theta.value)))

        self.equilibrium = Equilibrium(state, tissue, shares(old.ufl_cell, new.ufl_cell, self.theta), at_points)
        self._newton: GuardedNewton | None = None

    @property
    def newton(self) -> GuardedNewton:
        """The solver."""
        if self._newton is None:
            self._newton = GuardedNewton(self.equilibrium, self.settings, robust=True)
        return self._newton

    def close(self) -> None:
        """Free PETSc's objects."""
        if self._newton is not None:
            self._newton.close()
            self._newton = None

    def set(self, fraction: float) -> None:
        """theta."""
        self.theta.value = fraction

    def largest_part(self, done: float) -> float:
        """Largest further part of theta that keeps KEPT_RESERVE of 1 - r/L at every point of the present unknowns.

        r^2 is linear in theta at a frozen deformation, so the bound is in closed form.
        """
        equilibrium, quadrature = self.equilibrium, self.equilibrium.quadrature
        length = quadrature.owned(equilibrium.locking_length())
        self.theta.value = done
        now = quadrature.owned(equilibrium.limit_values()[0])
        self.theta.value = 1.0
        end = quadrature.owned(equilibrium.limit_values()[0])
        allowed = ((1 - KEPT_RESERVE) * length + KEPT_RESERVE * np.sqrt(now)) ** 2  # infinite where nothing locks
        growth = end - now
        room = np.where(growth > 0, (allowed - now) / np.where(growth > 0, growth, 1.0), np.inf)
        return (1.0 - done) * quadrature.minimum(room)


def shares(old: UnitCell, new: UnitCell, theta: Any) -> list[UnitCell]:
    """(1 - theta) of an old cell and theta of a new one, UFL or arrays."""
    return [UnitCell(*old[:2], 1 - theta), UnitCell(*new[:2], theta)]
