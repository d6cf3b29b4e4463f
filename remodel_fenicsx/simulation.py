"""A scene brought to life: builds the parts in their order and steps them through time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading, LoadValues
from remodel_fenicsx.body.reductions import AUTO, choice, explained, only_for_means
from remodel_fenicsx.evolution.coupling import Coupling, Maker
from remodel_fenicsx.evolution.remodeling import RemodelingPass
from remodel_fenicsx.evolution.stepper import Step, Stepper, Watcher, times
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import KINEMATICS, FreeLength, NaturalConfiguration
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import Tissue
from remodel_fenicsx.model.laws import LAWS
from remodel_fenicsx.model.axes import LocalAxes
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.results.run_folder import agreed
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.scene.scene import in_region
from remodel_fenicsx.schema.settings import Cells, Properties, Solver
from remodel_fenicsx.state.state import State, by_region
from remodel_fenicsx.state.state import UnitCells
from remodel_fenicsx.system.files import typed
from remodel_fenicsx.system.interrupts import take_back_signals
from remodel_fenicsx.watch.stability import EquilibriumStability
from remodel_fenicsx.watch.warnings import (
    FrontsInLayers,
    GrowthWithoutRest,
    LockingWarning,
    PressureNoise,
    REMEDY,
    RadialChains,
    VolumeLoss,
    WeakTension,
)
from remodel_fenicsx.watch.over_correction import OverCorrection, RestedCells

log = logging.getLogger(__name__)

TIME_ERROR = "time_error"  # the column
ELEMENTS_OF_A_LOOK, LARGEST_LOOK = 10**5, 10**8
"""Elements of a body, and bytes of a file of fibres, that are looked at in a few seconds without a run."""


class Simulation:
    """Everything that a scene needs, built and ready to step.

    Parameters
    ----------
    scene
        The validated scene.
    comm
        MPI communicator of the mesh.
    domain
        A mesh of the scene's body to take in place of the one that the scene asks for.
    coupling
        Makes a coupling in place of the one that the scene names.

    Attributes
    ----------
    domain, unknown, quadrature, cells, loading, state, tissue, stepper, observer
        The parts, each usable by itself (see demos/).
    control
        Chooses the steps, where the scene has a tolerance.
    stability, warnings
        Watchers of the stability of equilibria, and of over-correction, locking, volume, and chains that point out of
        the wall; what they remember is part of the state.

    Raises
    ------
    SceneError
        If `domain` is not a mesh of the scene's body and elements.
    TypeError
        If `scene` is none.

    Examples
    --------
    >>> from remodel_fenicsx import Simulation, preset_scene
    >>> scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"time.end": 2.0})
    >>> simulation = Simulation(scene)
    >>> for step in simulation.steps():
    ...     print(step.time, round(step.row["mean_stretch"], 3))
    1.0 1.081
    2.0 1.172
    >>> simulation.cells.dimension_values.shape  # l_I of this rank, (elements, points, 3), in link lengths
    (1, 8, 3)
    >>> simulation.close()
    """

    def __init__(
        self,
        scene: Scene,
        comm: MPI.Intracomm = MPI.COMM_WORLD,
        domain: Domain | None = None,
        coupling: Maker | None = None,
    ):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"not a Scene: {scene!r}; read_scene(PATH) makes one of a file, preset_scene one of a preset"
            )
        take_back_signals()
        if scene.geometry.is_loaded:
            raise SceneError(
                f"geometry.is = 'loaded': the unloaded body is needed; {typed()} unload SCENE writes its scene"
            )
        if domain is None and comm.rank == 0:
            for line in explained(scene) if scene.model.kinematics == AUTO else only_for_means(scene):
                log.info("%s", line)
        if scene.mesh.formulation == AUTO and comm.rank == 0:
            log.info("%s", scene.formulation_in_words())
        self.scene = scene = with_choices(scene, domain)
        self._loads = [case.loads for case in scene.each_case()]
        shape = scene.geometry
        self.domain = domain = checked_domain(build(scene, comm) if domain is None else domain, scene)
        mesh = domain.mesh
        # a state for each load case; made in the order of those of the first, so that all have the same kernels
        made = [on_mesh_alone(scene, domain) for _ in self._loads]
        unknowns = [one.unknown(mesh, scene.mesh.degree) for one in made]
        kinematics, self.unknown = made[0], unknowns[0]
        self.quadrature = Quadrature(mesh, scene.mesh.degree, kinematics.weight(mesh))
        properties, local_axes = scene.properties(), shape.local_axes(domain, self.quadrature)
        own = {name: properties[name].cells for name in scene.regions}
        if not scene.natural.is_of_the_mesh:
            natural = from_natural(kinematics, scene, self.quadrature, domain, local_axes)
            made = [NaturalConfiguration(one, natural.gradient, natural.closing) for one in made]
        fibres = measured_fibres(scene, domain)
        self.cells = UnitCells(self.quadrature, domain, scene.cells, local_axes, own, fibres)
        self.state, *others = (
            unloaded_state(scene, u, k, self.cells, domain) for u, k in zip(unknowns, made, strict=True)
        )
        self.loading = self.state.loading
        tissue, kappa = parameters_of(properties, domain)
        if scene.remodeling.turnover.is_on:
            from remodel_fenicsx.evolution.turnover import turned_over

            tissue = turned_over(tissue, self.state)
        self._cases: list[Any] = []  # further ones (`OtherCase`)
        at_once = scene.time.is_equilibrium
        predictor: str = scene.solver.predictor
        if (at_once or scene.time.tolerance is not None) and predictor != "none":
            predictor = "responsive"  # steps have all lengths
        solver = scene.solver.model_copy(update={"predictor": predictor})
        parts = self.state, tissue, scene.remodeling, solver, self.load_values
        if others and coupling is not None:
            raise SceneError("cases: a coupling of your own solves one load case; leave out [[cases]]")
        make = self._at_once(tissue, solver, kappa, others) if at_once else coupling
        self.stepper = Stepper(*parts, make, kappa)
        self.tissue = self.stepper.tissue
        if others:
            self._join_cases(self.stepper, others, solver, kappa)
        counted = "negative_eigenvalues" in scene.output.columns
        self.stability = EquilibriumStability(self.stepper, scene.solver.unstable, every_step=counted)
        self._closing = [self.stability]
        more: list[str] = []
        self.control: Any = None  # `StepControl`
        if scene.time.tolerance is not None and not at_once:
            from remodel_fenicsx.evolution.time_steps import StepControl

            settings = scene.time.tolerance, scene.time.step, scene.stops()
            self.control = StepControl(self.stepper, *settings)
            more += [TIME_ERROR] if TIME_ERROR not in scene.output.columns else []
        elif TIME_ERROR in scene.output.columns:
            from remodel_fenicsx.evolution.time_steps import TimeError

            self.stepper.judge = TimeError(self.stepper).measure
        self.observer = Observer(shape, self.stepper, scene.columns(more))
        self.warnings = self._of_the_state(self.stepper)
        remodeling, locks = self.stepper.remodeling, FORMULATIONS[scene.mesh.formulation].locks
        if locks and remodeling.law.remodels and remodeling.driver.is_stress and not kinematics.homogeneous:
            self.warnings.append(PressureNoise(self.stepper, remedy(scene)))
        self.warnings += [
            WeakTension(self.stepper),
            RadialChains(self.stepper, shape.radial_share),
            FrontsInLayers(self.stepper, shape),
        ]
        if self.stepper.turnover is not None:
            self.warnings.append(GrowthWithoutRest(self.stepper, scene.end_of_ramps))
        if self._cases:
            from remodel_fenicsx.evolution.load_cases import OtherCaseWatcher

            looked_at = [(case, EquilibriumStability(case, scene.solver.unstable)) for case in self._cases]
            self._closing += [stability for _, stability in looked_at]
            self.warnings += [
                OtherCaseWatcher(case, one) for case, own in looked_at for one in (own, *self._of_the_state(case))
            ]
        if self.stepper.remodeling.law.remodels and not at_once:
            over_correction = OverCorrection(self.stepper)
            self.warnings.insert(0, over_correction)
            if self.stepper.remodeling.law.of_absolute_time:
                self.warnings.append(RestedCells(self.stepper, over_correction))

    def _of_the_state(self, stepper: Any) -> list[Watcher]:
        """What is said of solved states, whatever the cells do: of a stepper's, or another load case's."""
        scene = self.scene
        found: list[Watcher] = [
            LockingWarning(stepper, FORMULATIONS[scene.mesh.formulation].locks, remedy(scene)),
            VolumeLoss(stepper),
        ]
        strut = scene.geometry.strut(scene.supports.ends) if stepper.state.kinematics.reduced else None
        if strut is not None:  # a whole body buckles by itself
            from remodel_fenicsx.watch.buckling import BucklingWarning

            found.insert(1, BucklingWarning(stepper, strut))
        return found

    def _at_once(self, tissue: Tissue, solver: Solver, kappa: Any, others: Sequence[State]) -> Maker:
        """The coupling that goes to the equilibrium, with the steps of a stepper of its own on the same state."""
        from remodel_fenicsx.evolution import homeostasis
        from remodel_fenicsx.evolution.time_steps import StepControl

        scene, stops = self.scene, self.scene.stops()
        settings, tolerance = scene.remodeling, scene.time.tolerance
        if tolerance is None:
            falls = any(load.falls for load in scene.loads.values())
            tolerance = homeostasis.UNLOADING if falls else homeostasis.TOLERANCE
        if scene.has_random_cells and LAWS[settings.law].dimensions is not None:
            # cells that jump from rank to rank: no step is short enough, and passes swing
            settings, tolerance = settings.model_copy(update={"coupling": "relaxed"}), homeostasis.COARSE
        way = Stepper(self.state, tissue, settings, solver, self.load_values, kappa=kappa)
        if others:
            self._join_cases(way, others, solver, kappa)
        way.coupling.longest = min(way.coupling.longest, homeostasis.LONGEST)
        control = StepControl(way, tolerance, scene.time.step, stops)
        until = scene.solver.model_copy(update={"maximum_iterations": homeostasis.LIMIT_ITERATIONS})

        def make(state: State, tissue: Tissue, remodeling: RemodelingPass, solver: Solver) -> Coupling:
            has_limit = scene.missing_for_implicit() is None
            limit = homeostasis.Limit(state, tissue, remodeling, until) if has_limit else None
            return homeostasis.Homeostasis(control, remodeling, max(stops[:-1], default=0.0), limit)

        return make

    def load_values(self, time: float, case: int = 0) -> LoadValues:
        """Magnitude of every load at a time, in a load case; the first is 0."""
        loads = self._loads[case].items()
        return {name: load.value * load.factor(time) for name, load in loads}

    def _join_cases(self, stepper: Stepper, states: Sequence[State], solver: Solver, kappa: Any) -> None:
        """Further load cases, on the same cells: the stepper follows them too, and the first that comes solves them."""
        from remodel_fenicsx.evolution.load_cases import OtherCase, follow, join

        weights = [case.weight for case in self.scene.cases]
        if self._cases:
            return follow(stepper, self._cases, weights)
        values = [partial(self.load_values, case=index) for index in range(1, len(self._loads))]
        parts = zip(states, values, strict=True)
        self._cases = [OtherCase(n, *part, stepper, solver, kappa) for n, part in enumerate(parts, start=2)]
        join(stepper, self._cases, weights)

    def steps(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Solve and remodel step by step, from where the state is; what is yielded has been accepted.

        The state seen at a yield is one pass ahead of the row: the row and the fields belong to the solved state,
        before the remodeling pass (docs/theory.md).

        Parameters
        ----------
        watchers
            Who else follows the steps; those who watch the stability and fill each step's row come first.

        Raises
        ------
        StepFailure
            If a step has no admissible equilibrium.
        """
        watchers = [self.stability, self.observer, *self.warnings, *watchers]
        if self.control is not None:
            return self.control.march(watchers)
        return self.stepper.march(self.remaining(), watchers)

    def remaining(self) -> list[float]:
        """Times of the steps that are left, where they are fixed."""
        scene, state = self.scene, self.state
        if scene.time.is_equilibrium:
            return [scene.last_time] if state.time < scene.last_time else []
        return list(times(scene.time.end, scene.time.step))[state.number :]

    def close(self) -> None:
        """Free PETSc's objects and options."""
        for stability in self._closing:
            stability.close()
        self.stepper.close()


def remedy(scene: Scene) -> str:
    """What a scene may set whose elements lock, in words."""
    if needs := scene.needs_all_points():
        return f"set mesh.degree = 2 or a larger mesh.refinement, for {needs} needs mesh.formulation = 'displacement'"
    return REMEDY


def on_mesh_alone(scene: Scene, domain: Domain) -> Any:
    """The scene's kinematics, of a mesh that is free of stress."""
    kinematics = KINEMATICS[scene.model.kinematics].on(domain.mesh, scene.geometry)
    return FreeLength(kinematics, scene.geometry) if scene.has_free_length else kinematics


def unloaded_state(scene: Scene, unknown: Any, kinematics: Any, cells: UnitCells, domain: Domain) -> State:
    """Unknowns of the body with its supports, and with loads that are zero."""
    shape, loading = scene.geometry, Loading(domain, unknown, kinematics)
    shape.support(loading, scene.supports.ends)
    matrices = [one.material for one in scene.properties().values()]
    modulus = max(material.lame_lambda + 2 * material.lame_mu for material in matrices)
    shape.hold_faces(loading, scene.supports.faces, modulus, scene.loads)
    return State(unknown, kinematics, cells, loading, FORMULATIONS[scene.mesh.formulation])


def from_natural(
    kinematics: Any, scene: Scene, quadrature: Quadrature, domain: Domain, local_axes: LocalAxes
) -> NaturalConfiguration:
    """The kinematics of a body whose tissue is free of stress in another configuration than the mesh's."""
    from remodel_fenicsx.body.natural import gradient, prestretch
    from remodel_fenicsx.model.residual_stress import closing

    natural, shape, found = scene.natural, scene.geometry, None
    for index, layer in enumerate(natural.layers):
        if layer.region is not None and layer.region not in domain.regions:
            known = ", ".join(map(repr, domain.regions))
            raise SceneError(f"natural.layers[{index}].region = {layer.region!r}: no such region; there are {known}")
    if shape.closes_from_a_sector:
        tissues = {name: properties.tissue for name, properties in scene.properties().items()}
        try:
            found = closing(shape.layers_of_tissue(natural, scene.regions, tissues), natural.opening_angle)
        except ArithmeticError as error:
            asked = f"natural.opening_angle = {natural.opening_angle:g}"
            raise SceneError(f"{asked}: must be smaller, or natural.layers nearer to 1: {error}") from error
        stretches = found.stretches(np.linalg.norm(local_axes.coordinates[..., :2], axis=-1))
    else:
        stretches = prestretch(natural, local_axes, domain)
    function = quadrature.function("natural_gradient", (3, 3))
    values = gradient(stretches, local_axes.axes)
    quadrature.values(function, (3, 3))[:] = values.reshape(*quadrature.shape, 3, 3)
    return NaturalConfiguration(kinematics, function, found)


def measured_fibres(scene: Scene, domain: Domain) -> dict[str, dict[str, Any]]:
    """Measured fibres by region and name, a row for each element of the mesh, on all ranks. Collective."""
    if not scene.measured_cells:
        return {}
    points, elements = domain.gather_mesh()
    regions = domain.gather_elements(domain.element_region)

    def read() -> dict[str, dict[str, Any]] | None:
        if points is None or elements is None or regions is None:
            return None
        found = {}
        for name, cells in scene.measured_cells.items():
            chosen = regions == domain.regions[name] if name else np.ones(len(regions), dtype=np.bool_)
            found[name] = _fibres_of(cells, name, points[elements], chosen)
        return found

    return domain.comm.bcast(agreed(domain.comm, read)) or {}


def _fibre_file(cells: Cells, region: str) -> Any:
    from remodel_fenicsx.body.fibres import FibreFileError, read_fibre_file  # few scenes have one

    try:
        file = read_fibre_file(Path(str(cells.fibres)))
        if cells.fibres_sha256 not in (None, file.sha256):
            raise FibreFileError(f"has changed: its SHA-256 was {str(cells.fibres_sha256)[:12]}...")
    except FibreFileError as error:
        raise SceneError(f"{in_region(region)}cells.fibres = {cells.fibres!r}: {error}") from error
    return file


def _fibres_of(cells: Cells, region: str, corners: Any, chosen: Any) -> dict[str, Any]:
    from remodel_fenicsx.body.fibres import FibreFileError

    key, file = f"{in_region(region)}cells.fibres", _fibre_file(cells, region)
    try:
        rows, farthest = file.rows_of(corners, chosen)
    except FibreFileError as error:
        raise SceneError(f"{key} = {cells.fibres!r}: {error}") from error
    count, names = len(next(iter(file.measured.values()))), ", ".join(file.measured)
    way = "by number" if farthest is None else f"the nearest ones, {farthest:.3g} away at most"
    log.info("%s: %s of %d rows, %s; SHA-256 %s", key, names, count, way, file.sha256)
    return {name: values[rows] for name, values in file.measured.items()}


def check_files(scene: Scene) -> str:
    """Refuse what a run would, of the files that a scene names; in words what was not looked at. For one rank."""
    large = []
    for name, cells in scene.measured_cells.items():
        file = Path(str(cells.fibres))
        if file.is_file() and file.stat().st_size > LARGEST_LOOK:
            large.append(f"{in_region(name)}cells.fibres (over {LARGEST_LOOK / 1e6:g} MB)")
        else:
            _fibre_file(cells, name)
    number = scene.geometry.number_of_elements * scene.mesh.refinement**3
    if large or number > ELEMENTS_OF_A_LOOK:
        return f"{', '.join([*large, f'how files fit the body of {number} elements'])}; the run does"
    scene = with_choices(scene)
    domain = checked_domain(build(scene, MPI.COMM_SELF), scene)
    scene.geometry.check_faces(domain, scene.supports.faces, scene.loads)
    measured_fibres(scene, domain)
    return ""


def parameters_of(properties: Mapping[str, Properties], domain: Domain) -> tuple[Tissue, Any]:
    """Tissue and kappa of a scene's regions: numbers where these agree, DG0 Functions where they differ."""
    tissues = {name: one.tissue for name, one in properties.items()}
    kappas = {name: one.kappa for name, one in properties.items()}
    tissue, kappa = next(iter(tissues.values())), next(iter(kappas.values()))
    if any(other != tissue for other in tissues.values()):
        tissue = tissue.map(lambda key, _: by_region(domain, {name: t.parameters[key] for name, t in tissues.items()}))
    return tissue, kappa if len(set(kappas.values())) == 1 else by_region(domain, kappas)


def with_choices(scene: Scene, domain: Domain | None = None) -> Scene:
    """The scene with what it is run with where it leaves the choice. A mesh of one's own is full."""
    if AUTO not in (scene.model.kinematics, scene.mesh.formulation):
        return scene
    name = choice(scene).name if domain is None or scene.model.kinematics != AUTO else "full"
    return scene.with_values({"model.kinematics": name, "mesh.formulation": scene.formulation})


def build(scene: Scene, comm: MPI.Intracomm) -> Domain:
    """The mesh of a scene: of its body, or of the part that stands for it. Collective."""
    if KINEMATICS[scene.model.kinematics].reduced:
        domain: Domain = scene.geometry.reductions[scene.model.kinematics].build(scene, comm)
        return domain
    return scene.geometry.build_with(scene.regions, scene.mesh, comm)


def checked_domain(domain: Domain, scene: Scene) -> Domain:
    """The domain, if it is a mesh of the scene's body and elements."""
    shape, mesh = scene.geometry, domain.mesh
    kind, degree = mesh.topology.cell_name(), mesh.geometry.cmap.degree
    if domain.shape != shape.name:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh is a {domain.shape!r}")
    element = KINEMATICS[scene.model.kinematics].element(scene.mesh.element)
    if kind != element:
        raise SceneError(f"mesh.element = {scene.mesh.element!r}: the mesh has elements of type {kind!r}")
    if degree != scene.mesh.degree:
        raise SceneError(f"mesh.degree = {scene.mesh.degree}: the mesh has degree {degree}")
    for name in scene.regions:
        if name not in domain.regions:
            raise SceneError(f"regions.{name}: the mesh has no such region; it has {', '.join(domain.regions)}")
    if scene.regions and shape.is_filled_by_regions and (others := set(domain.regions) - set(scene.regions)):
        raise SceneError(f"regions.{min(others)}: missing; it is a region of the mesh")
    needed = () if KINEMATICS[scene.model.kinematics].reduced else shape.face_names
    missing = [face for face in needed if face not in domain.faces]
    if missing:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh has no face {', '.join(missing)}")
    for name, value in domain.dimensions.items():
        wanted = getattr(shape, name, value)
        if not abs(wanted - value) <= 1e-9 * abs(wanted):  # NaN too
            raise SceneError(f"geometry.{name} = {wanted:g}: that of the mesh is {value:g}")
    empty = [name for name in needed if not domain.comm.allreduce(domain.facet_tags.find(domain.faces[name]).size)]
    if empty:
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh has no facets with the tag of {', '.join(empty)}")
    if not domain.comm.allreduce(bool(np.isfinite(mesh.geometry.x).all()), MPI.LAND):
        raise SceneError(f"geometry.shape = {shape.name!r}: the mesh has nodes that are not finite")
    return domain
