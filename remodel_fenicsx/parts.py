"""Parts from which scripts assemble a simulation without a scene, as in demos/artery.py.

Stresses, lengths and times are in the script's units, which must be consistent. Dimensions of unit
cells and lengths of chains are in link lengths, angles in degrees.

Examples
--------
>>> from remodel_fenicsx import parts
>>> body = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
>>> body.face_names
('bottom', 'top', 'inner', 'outer')
"""

from typing import TYPE_CHECKING

from remodel_fenicsx.body.box import Cube as Cube, Sheet as Sheet
from remodel_fenicsx.body.domain import Domain as Domain
from remodel_fenicsx.body.gmsh_model import GeometryError as GeometryError
from remodel_fenicsx.body.loading import Loading as Loading
from remodel_fenicsx.body.shape import columns_of as columns_of
from remodel_fenicsx.body.tendon import Tendon as Tendon
from remodel_fenicsx.body.tube import Tube as Tube
from remodel_fenicsx.evolution.stepper import (
    Step as Step,
    Stepper as Stepper,
    Watcher as Watcher,
    times as times,
)
from remodel_fenicsx.fem.kinematics import FullKinematics as FullKinematics
from remodel_fenicsx.fem.quadrature import Quadrature as Quadrature
from remodel_fenicsx.model.energy import Tissue as Tissue
from remodel_fenicsx.results.columns import Observer as Observer
from remodel_fenicsx.results.fields import Fields as Fields
from remodel_fenicsx.results.run_folder import (
    FolderTaken as FolderTaken,
    RunFolder as RunFolder,
    chosen_folder as chosen_folder,
)
from remodel_fenicsx.schema.settings import (
    Cells as Cells,
    Material as Material,
    Mesh as Mesh,
    Remodeling as Remodeling,
    Solver as Solver,
)
from remodel_fenicsx.solver.continuation import StepFailure as StepFailure
from remodel_fenicsx.state import State as State, UnitCells as UnitCells
from remodel_fenicsx.system.interrupts import (
    end_all_ranks_on_exception as end_all_ranks_on_exception,
)

if not TYPE_CHECKING:  # type checkers use the imports
    __all__ = sorted(
        name for name in globals() if name != "TYPE_CHECKING" and not name.startswith("_")
    )
