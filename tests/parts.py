"""A body with its cells and supports, put together by hand: what tests of single parts of the package start from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from remodel_fenicsx.body import SHAPES, Cube, Tendon, Tube
from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading, LoadValues
from remodel_fenicsx.body.shape import Shape
from remodel_fenicsx.body.tube import PAPER, whole_tube
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import Stepper
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import FullKinematics
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.scene.scene import Mesh, Scene, Solver
from remodel_fenicsx.schema.settings import Cells, Material, Remodeling
from remodel_fenicsx.solver.equilibrium import Equilibrium
from remodel_fenicsx.solver.newton import GuardedNewton, Solution
from remodel_fenicsx.state import State, UnitCells
from tests.values import ramped

MATERIAL = Material()
TIGHT = Solver(absolute_tolerance=1e-11, relative_tolerance=1e-13)


def cube(side: float = 1.0, comm: MPI.Intracomm | None = None, **mesh: Any) -> Domain:
    """The mesh of a cube."""
    return Cube(side=side).build(Mesh(**mesh), comm)


def tendon(
    length: float = 10.0, area: float = 10.0, comm: MPI.Intracomm | None = None, **mesh: Any
) -> Domain:
    """The mesh of a tendon."""
    return Tendon(length=length, area=area).build(Mesh(**mesh), comm)


def tube(
    inner_radius: float = 1.0,
    outer_radius: float = 3.0,
    length: float = 8.0,
    refinement: int = 1,
    element: str = "hexahedron",
    degree: int = 1,
    comm: MPI.Intracomm | None = None,
    divisions: tuple[int, int, int] = PAPER,
) -> Domain:
    """The mesh of a tube with elements around, through the wall and along, times the refinement."""
    shape = Tube(inner_radius=inner_radius, outer_radius=outer_radius, length=length)
    around, through, along = (refinement * count for count in divisions)
    return whole_tube(shape, (around, through, along), element, degree, comm)


def rotation(axis: Sequence[float], degrees: float) -> np.ndarray:
    """The rotation about an axis, (3, 3)."""
    return Rotation.from_rotvec(
        degrees / np.linalg.norm(axis) * np.asarray(axis), degrees=True
    ).as_matrix()


def symmetric(values: Any, axes: np.ndarray) -> np.ndarray:
    """Tensors with these values (3,) or (n, 3) along the rows of axes (n, 3, 3)."""
    return np.swapaxes(axes, 1, 2) @ (np.broadcast_to(values, axes.shape[:2])[:, :, None] * axes)


def smooth(nodes: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """A smooth displacement without symmetries, one row per node."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.uniform(1.0, 2.0, (3, 3)), rng.uniform(0.0, 6.0, 3)
    return scale * np.sin(nodes / np.ptp(nodes, axis=0) @ waves + phases)


def pulled_cube(end: float, **tables: Any) -> Scene:
    """A cube of eight elements with random cells, pulled for four of `end` units of time and remodeled."""
    return Scene(
        preset="kuhl-holzapfel-2007",
        geometry={"shape": "cube"},
        mesh={"refinement": 2},
        cells={"initial": "random"},
        loads=ramped(4.0, force=8.0),
        remodeling={"kappa": 0.1},
        time={"end": end},
        **tables,
    )


def clamped_cube() -> Body:
    """Eight elements of random cells, the bottom clamped, a dead force on the top."""
    made = body(cube(refinement=2), Cells(initial="random", seed=3))
    for component in range(3):
        made.loading.hold_face("z0", component)
    made.loading.add_dead_force("force", "z1", component=2)
    return made


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rotations, (count, 3, 3)."""
    matrices = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    return matrices * np.linalg.det(matrices)[:, None, None]


class Problem(Equilibrium):
    """An equilibrium with its solver."""

    def __init__(self, state: State, material: Material, solver: Solver):
        super().__init__(state, material.tissue(state.cells.settings.end_to_end_length))
        self.newton = GuardedNewton(self, solver)

    def solve(self) -> Solution:
        """From the present unknowns."""
        return self.newton.solve()


@dataclass
class Body:
    """A meshed body, its displacement and its cells; supports and loads are for the test to add."""

    domain: Domain
    displacement: Any
    quadrature: Quadrature
    cells: UnitCells
    loading: Loading
    kinematics: FullKinematics = field(default_factory=FullKinematics)
    formulation: str = "displacement"

    def state(self) -> State:
        """Its state, with the loads as they are."""
        loads = dict(self.loading.values)
        formulation = FORMULATIONS[self.formulation]
        state = State(self.displacement, self.kinematics, self.cells, self.loading, formulation)
        self.loading.set(loads)
        return state

    def problem(self, solver: Solver = TIGHT, material: Material = MATERIAL) -> Problem:
        """Its equilibrium."""
        return Problem(self.state(), material, solver)

    def remodeling(self, material: Material = MATERIAL, **settings: Any) -> RemodelingPass:
        """A pass on it."""
        tissue = material.tissue(self.cells.settings.end_to_end_length)
        return RemodelingPass(self.state(), tissue, Remodeling(**settings))

    def stepper(
        self, load_values: Callable[[float], LoadValues], solver: Solver = TIGHT, **remodeling: Any
    ) -> Stepper:
        """Its way through time."""
        tissue = MATERIAL.tissue(self.cells.settings.end_to_end_length)
        return Stepper(self.state(), tissue, Remodeling(**remodeling), solver, load_values)

    def supported(self) -> Body:
        """The same, held and loaded as its shape is in a scene."""
        self.loading = Loading(self.domain, self.displacement)
        shape_of(self.domain).support(self.loading)
        return self

    def set_displacement(self, values: np.ndarray) -> None:
        """Displacement by local node, (nodes, 3)."""
        self.displacement.x.array[:] = np.asarray(values).ravel()

    @property
    def nodes(self) -> np.ndarray:
        """Reference coordinates of the nodes of the displacement, (nodes, 3)."""
        return self.displacement.function_space.tabulate_dof_coordinates()


def shape_of(domain: Domain) -> Shape:
    """The shape whose mesh it is."""
    dimensions = {name: value for name, value in domain.dimensions.items() if name != "radius"}
    made: Shape = SHAPES[domain.shape](shape=domain.shape, **dimensions)
    return made


def body(domain: Domain, cells: Cells, degree: int = 1) -> Body:
    """Cells, quadrature and displacement of a mesh."""
    displacement = FullKinematics().unknown(domain.mesh, degree)
    quadrature = Quadrature(domain.mesh, degree)
    local_axes = shape_of(domain).local_axes(domain, quadrature)
    unit_cells = UnitCells(quadrature, domain, cells, local_axes)
    return Body(domain, displacement, quadrature, unit_cells, Loading(domain, displacement))


def random_axes(made: Body, rng: np.random.Generator) -> None:
    """Turn the cell of every quadrature point by a rotation of its own."""
    cells = made.cells
    axes = random_rotations(rng, int(np.prod(made.quadrature.shape))).reshape(
        cells.axis_values.shape
    )
    cells.set(cells.dimension_values.copy(), axes)
