"""Registries, and what is put into them: a scene then knows the name. CONTRIBUTING.md says which to use for what.

    from remodel_fenicsx.extend import DRIVERS, Driver

    DRIVERS["mine"] = Driver(lambda F, stresses: stresses.cauchy, material=False)

Importing this needs no dolfinx; asking for couplings, measurements, linear solvers or `form` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from remodel_fenicsx._lazy import on_demand
from remodel_fenicsx.body import SHAPES, LoadKind, Shape
from remodel_fenicsx.body.columns import COLUMNS, COLUMNS_ON_REQUEST, Column
from remodel_fenicsx.body.reductions import Reduction
from remodel_fenicsx.body.shape import uniaxial_columns
from remodel_fenicsx.fem.formulations import FORMULATIONS, Formulation, Selective
from remodel_fenicsx.fem.kinematics import KINEMATICS, FullKinematics, Kinematics
from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS, SolverMethod
from remodel_fenicsx.model.cells import UnitCell, angle_to_axis
from remodel_fenicsx.model.chains import CHAINS, Chain
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
from remodel_fenicsx.model.local_axes import AXES, LocalAxes
from remodel_fenicsx.model.spectral import PAIRINGS, principal
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
from remodel_fenicsx.settings import COUPLINGS, CouplingKind

if TYPE_CHECKING:
    from remodel_fenicsx.evolution.coupling import Coupling, Staggered
    from remodel_fenicsx.fem.jit import form
    from remodel_fenicsx.results.columns import Measurement
    from remodel_fenicsx.solver.linear import EveryTangent

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
    "UnitCell",
    "angle_to_axis",
    "axes_sum",
    "form",
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
        **dict.fromkeys(("Coupling", "Staggered"), "evolution.coupling"),
        "EveryTangent": "solver.linear",
        "Measurement": "results.columns",
        "form": "fem.jit",
    },
)
