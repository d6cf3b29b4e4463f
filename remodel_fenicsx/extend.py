"""Registries of the package, and the types of their entries, whose names scenes may use.

CONTRIBUTING.md says which registry to use. Importing this module needs no dolfinx. Access to
couplings, measurements, linear solvers, `WarnsOnce` or `form` does.

Attributes
----------
AXES
    Initial axes of the cells by name (`cells.axes`): functions of a `LocalAxes` that return rows
    n_I, (..., 3, 3).
CHAINS
    Laws of a single chain by name (`material.chain`): `Chain`.
COLUMNS, COLUMNS_ON_REQUEST
    Columns of every shape's history by name, always present or on request by `output.columns`:
    `Column`.
COUPLINGS
    Couplings of equilibrium and remodeling by name (`remodeling.coupling`): `CouplingKind`.
DRIVERS
    Driving tensors by name (`remodeling.driver`; paper, eq. 8): `Driver`.
FORMULATIONS
    Formulations of the volumetric energy in elements by name (`mesh.formulation`): `Formulation`.
FRAMES
    Maps from eigenvectors of a spatial driver to axes by name (`remodeling.frame`; paper, eq. 9):
    `Frame`.
KINEMATICS
    Kinematics by name (`model.kinematics`): `Kinematics`.
LAWS
    Evolution laws by name (`remodeling.law`; paper, eqs. 10 and 11): `Law`.
MATRICES
    Energies of the matrix by name (`material.matrix`): functions of F, lambda and mu; `Matrix` for
    all formulations.
PAIRINGS
    Pairings of principal values and dimensions by name (`remodeling.pairing`): functions like
    `principal`.
REMODELS
    Remodeling processes in addition to the cells, by the name of their table in `[remodeling]`:
    `RemodelsKind`.
REPULSIONS
    Forms of the repulsive energy by name (`material.repulsion`): `Repulsion`.
SHAPES
    Bodies by name (`geometry.shape`): subclasses of `Shape`.
SOLVER_METHODS
    Methods for the nonlinear problem by name (`solver.method`): `SolverMethod`.
WATCHERS
    Watchers of every run by name: `WatcherKind`, usually of a `WarnsOnce`.
neo_hookean
    The paper's matrix, W = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J (eq. 4a): a `Matrix`.
AREA, FORCE, LENGTH, NUMBER_DENSITY, STRESS, TEMPERATURE
    Dimension of a scene's number, for the field of a table: ``side: Annotated[float, LENGTH]``; a
    `Dimension`.
LENGTH_UNIT, STRESS_UNIT
    Keys that set a scene's units, for a custom `Dimension`.

Examples
--------
>>> from remodel_fenicsx.extend import DRIVERS, Driver
>>> DRIVERS["mine"] = Driver(lambda F, stresses: stresses.cauchy, material=False)
>>> sorted(DRIVERS)
['cauchy', 'finger', 'mine', 'pk2']
>>> del DRIVERS["mine"]
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from remodel_fenicsx._lazy import on_demand
from remodel_fenicsx.body import SHAPES as SHAPES, LoadKind as LoadKind, Shape as Shape
from remodel_fenicsx.body.box import box_domain as box_domain
from remodel_fenicsx.body.shape import (
    COLUMNS as COLUMNS,
    COLUMNS_ON_REQUEST as COLUMNS_ON_REQUEST,
    Column as Column,
    End as End,
    WithAxes as WithAxes,
    WithRegions as WithRegions,
    cauchy_columns as cauchy_columns,
    uniaxial_columns as uniaxial_columns,
)
from remodel_fenicsx.body.wall import Walled as Walled
from remodel_fenicsx.body.reductions import Reduction as Reduction
from remodel_fenicsx.fem.formulations import (
    FORMULATIONS as FORMULATIONS,
    Formulation as Formulation,
    Selective as Selective,
)
from remodel_fenicsx.fem.kinematics import (
    KINEMATICS as KINEMATICS,
    FullKinematics as FullKinematics,
    Kinematics as Kinematics,
)
from remodel_fenicsx.fem.solver_methods import (
    SOLVER_METHODS as SOLVER_METHODS,
    SolverMethod as SolverMethod,
)
from remodel_fenicsx.model.cells import UnitCell as UnitCell, angle_to_axis as angle_to_axis
from remodel_fenicsx.model.chains import CHAINS as CHAINS, Chain as Chain, Parameter as Parameter
from remodel_fenicsx.model.drivers import (
    DRIVERS as DRIVERS,
    FRAMES as FRAMES,
    Driver as Driver,
    Frame as Frame,
)
from remodel_fenicsx.model.energy import (
    MATRICES as MATRICES,
    REPULSIONS as REPULSIONS,
    Matrix as Matrix,
    Repulsion as Repulsion,
    Stresses as Stresses,
    axes_sum as axes_sum,
    neo_hookean as neo_hookean,
    squared_end_to_end_length as squared_end_to_end_length,
)
from remodel_fenicsx.model.laws import LAWS as LAWS, Drive as Drive, Law as Law, ranked as ranked
from remodel_fenicsx.model.axes import AXES as AXES, LocalAxes as LocalAxes
from remodel_fenicsx.model.spectral import PAIRINGS as PAIRINGS, principal as principal
from remodel_fenicsx.model.tensors import ln as ln
from remodel_fenicsx.schema.settings import (
    COUPLINGS as COUPLINGS,
    REMODELS as REMODELS,
    CouplingKind as CouplingKind,
    RemodelsKind as RemodelsKind,
)
from remodel_fenicsx.schema.tables import Table as Table
from remodel_fenicsx.schema.units import (
    AREA as AREA,
    FORCE as FORCE,
    LENGTH as LENGTH,
    LENGTH_UNIT as LENGTH_UNIT,
    NUMBER_DENSITY as NUMBER_DENSITY,
    STRESS as STRESS,
    STRESS_UNIT as STRESS_UNIT,
    TEMPERATURE as TEMPERATURE,
    Dimension as Dimension,
)
from remodel_fenicsx.watch import WATCHERS as WATCHERS, WatcherKind as WatcherKind

if TYPE_CHECKING:
    from remodel_fenicsx.evolution.coupling import (
        Coupling as Coupling,
        Staggered as Staggered,
        Traits as Traits,
    )
    from remodel_fenicsx.evolution.life_cycle import Remodels as Remodels
    from remodel_fenicsx.fem.jit import form as form
    from remodel_fenicsx.results.columns import Measurement as Measurement
    from remodel_fenicsx.solver.linear import FullNewton as FullNewton
    from remodel_fenicsx.evolution.stepper import WarnsOnce as WarnsOnce

_LATE = {
    **dict.fromkeys(("Coupling", "Staggered", "Traits"), "evolution.coupling"),
    "FullNewton": "solver.linear",
    "Measurement": "results.columns",
    "Remodels": "evolution.life_cycle",
    "WarnsOnce": "evolution.stepper",
    "form": "fem.jit",
}
__getattr__ = on_demand(__name__, _LATE)
if not TYPE_CHECKING:  # type checkers use the imports
    _HELPERS = ("annotations", "TYPE_CHECKING", "on_demand")
    __all__ = sorted(
        name for name in {*globals(), *_LATE} if name not in _HELPERS and not name.startswith("_")
    )
