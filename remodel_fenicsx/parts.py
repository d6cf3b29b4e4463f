"""What a script assembles a simulation from, where a scene does not say it: see demos/artery.py.

Stresses, lengths and times are in the script's own units, the same everywhere; dimensions of unit cells and lengths of
chains are in link lengths, angles in degrees.

Examples
--------
>>> from remodel_fenicsx import parts
>>> body = parts.Tube(inner_radius=1.0, outer_radius=3.0, length=8.0)
>>> body.face_names
('bottom', 'top', 'inner', 'outer')
"""

from remodel_fenicsx.body import Cube, GeometryError, Tendon, Tube
from remodel_fenicsx.body.shape import columns_of
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher, times
from remodel_fenicsx.fem.kinematics import FullKinematics
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.results.fields import Fields
from remodel_fenicsx.results.run_folder import FolderTaken, RunFolder, chosen_folder
from remodel_fenicsx.schema.settings import Cells, Material, Mesh, Remodeling, Solver
from remodel_fenicsx.solver.continuation import StepFailure
from remodel_fenicsx.state.state import State
from remodel_fenicsx.state.state import UnitCells
from remodel_fenicsx.system.interrupts import end_all_ranks_on_exception

__all__ = [
    "Cells",
    "Cube",
    "Domain",
    "Fields",
    "FolderTaken",
    "FullKinematics",
    "GeometryError",
    "Loading",
    "Material",
    "Mesh",
    "Observer",
    "Quadrature",
    "Remodeling",
    "RunFolder",
    "Solver",
    "State",
    "Step",
    "StepFailure",
    "Stepper",
    "Tendon",
    "Tissue",
    "Tube",
    "UnitCells",
    "Watcher",
    "chosen_folder",
    "columns_of",
    "end_all_ranks_on_exception",
    "times",
]
