"""Registries, and what is put into them: a scene then knows the name. CONTRIBUTING.md says which to use for what.

Importing this needs no dolfinx; asking for couplings, measurements, linear solvers, `WarnsOnce` or `form` does.

Attributes
----------
AXES
    Initial axes of the cells by name (`cells.axes`): functions of a `LocalAxes` that give rows n_I, (..., 3, 3).
CHAINS
    Laws of a single chain by name (`material.chain`): `Chain`.
COLUMNS, COLUMNS_ON_REQUEST
    Columns of every shape's history by name, those that are always there and those that `output.columns` may name:
    `Column`.
COUPLINGS
    How equilibrium and remodeling are coupled, by name (`remodeling.coupling`): `CouplingKind`.
DRIVERS
    Driving tensors by name (`remodeling.driver`; paper, eq. 8): `Driver`.
FORMULATIONS
    Where elements take the change of volume, by name (`mesh.formulation`): `Formulation`.
FRAMES
    What becomes of the eigenvectors of a spatial driver, by name (`remodeling.frame`; paper, eq. 9): `Frame`.
KINEMATICS
    What the unknowns mean, by name (`model.kinematics`): `Kinematics`.
LAWS
    Evolution laws by name (`remodeling.law`; paper, eqs. 10 and 11): `Law`.
MATRICES
    Energies of the matrix by name (`material.matrix`): functions of F, lambda and mu; `Matrix` for all formulations.
PAIRINGS
    Which principal value belongs to which dimension, by name (`remodeling.pairing`): functions like `principal`.
REPULSIONS
    Forms of the repulsive energy by name (`material.repulsion`): `Repulsion`.
SHAPES
    Bodies by name (`geometry.shape`): subclasses of `Shape`.
SOLVER_METHODS
    How the nonlinear problem is solved, by name (`solver.method`): `SolverMethod`.
WATCHERS
    Who looks on and warns in every run, by name: `WatcherKind`, most often of a `WarnsOnce`.
neo_hookean
    The paper's matrix, W = lambda/2 ln^2 J + mu/2 (tr C - 3) - mu ln J (eq. 4a): a `Matrix`.
AREA, FORCE, LENGTH, NUMBER_DENSITY, STRESS, TEMPERATURE
    What a number of a scene measures, for the field of a table: ``side: Annotated[float, LENGTH]``; a `Dimension`.
LENGTH_UNIT, STRESS_UNIT
    The keys that choose a scene's units, for a `Dimension` of one's own.

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
from remodel_fenicsx.body import SHAPES, LoadKind, Shape
from remodel_fenicsx.body.cube import box_domain
from remodel_fenicsx.body.shape import COLUMNS, COLUMNS_ON_REQUEST, Column, End, WithRegions, uniaxial_columns
from remodel_fenicsx.body.wall import Walled
from remodel_fenicsx.body.reductions import Reduction
from remodel_fenicsx.fem.formulations import FORMULATIONS, Formulation, Selective
from remodel_fenicsx.fem.kinematics import KINEMATICS, FullKinematics, Kinematics
from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS, SolverMethod
from remodel_fenicsx.model.cells import UnitCell, angle_to_axis
from remodel_fenicsx.model.chains import CHAINS, Chain, Parameter
from remodel_fenicsx.model.drivers import DRIVERS, FRAMES, Driver, Frame
from remodel_fenicsx.model.energy import (
    MATRICES,
    REPULSIONS,
    Matrix,
    Repulsion,
    Stresses,
    axes_sum,
    neo_hookean,
    squared_end_to_end_length,
)
from remodel_fenicsx.model.laws import LAWS, Drive, Law, ranked
from remodel_fenicsx.model.axes import AXES, LocalAxes
from remodel_fenicsx.model.spectral import PAIRINGS, principal
from remodel_fenicsx.model.tensors import linear_map, ln
from remodel_fenicsx.schema.settings import COUPLINGS, CouplingKind
from remodel_fenicsx.schema.tables import markdown_reference
from remodel_fenicsx.schema.units import (
    AREA,
    FORCE,
    LENGTH,
    LENGTH_UNIT,
    NUMBER_DENSITY,
    STRESS,
    STRESS_UNIT,
    TEMPERATURE,
    Dimension,
)
from remodel_fenicsx.watch import WATCHERS, WatcherKind

if TYPE_CHECKING:
    from remodel_fenicsx.evolution.coupling import Coupling, Staggered, Traits
    from remodel_fenicsx.fem.jit import form
    from remodel_fenicsx.results.columns import Measurement
    from remodel_fenicsx.solver.linear import EveryTangent
    from remodel_fenicsx.watch.warnings import WarnsOnce

__all__ = [
    "AREA",
    "AXES",
    "CHAINS",
    "COLUMNS",
    "COLUMNS_ON_REQUEST",
    "COUPLINGS",
    "Chain",
    "Column",
    "Coupling",
    "CouplingKind",
    "DRIVERS",
    "Dimension",
    "Drive",
    "Driver",
    "End",
    "EveryTangent",
    "FORCE",
    "FORMULATIONS",
    "FRAMES",
    "Formulation",
    "Frame",
    "FullKinematics",
    "KINEMATICS",
    "Kinematics",
    "LAWS",
    "LENGTH",
    "LENGTH_UNIT",
    "Law",
    "LoadKind",
    "LocalAxes",
    "MATRICES",
    "Matrix",
    "Measurement",
    "NUMBER_DENSITY",
    "PAIRINGS",
    "Parameter",
    "REPULSIONS",
    "Reduction",
    "Repulsion",
    "SHAPES",
    "SOLVER_METHODS",
    "STRESS",
    "STRESS_UNIT",
    "Selective",
    "Shape",
    "SolverMethod",
    "Staggered",
    "Stresses",
    "TEMPERATURE",
    "Traits",
    "UnitCell",
    "WATCHERS",
    "WarnsOnce",
    "WatcherKind",
    "Walled",
    "WithRegions",
    "angle_to_axis",
    "axes_sum",
    "box_domain",
    "form",
    "linear_map",
    "ln",
    "markdown_reference",
    "neo_hookean",
    "principal",
    "ranked",
    "squared_end_to_end_length",
    "uniaxial_columns",
]

__getattr__ = on_demand(
    __name__,
    {
        **dict.fromkeys(("Coupling", "Staggered", "Traits"), "evolution.coupling"),
        "EveryTangent": "solver.linear",
        "Measurement": "results.columns",
        "WarnsOnce": "watch.warnings",
        "form": "fem.jit",
    },
)
