"""A scene brought to life: builds the parts in their order and steps them through time."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx.fem import Function
from mpi4py import MPI

from remodel_fenicsx.body.domain import Domain
from remodel_fenicsx.body.loading import Loading, LoadValues, values_of_loads
from remodel_fenicsx.body.reductions import AUTO, choice, explained, only_for_means
from remodel_fenicsx.body.wall import RoundWall
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.evolution.coupling import Maker
from remodel_fenicsx.evolution.stepper import OtherCase, OtherCaseWatcher, Step, Stepper, Watcher, times
from remodel_fenicsx.fem.formulations import FORMULATIONS
from remodel_fenicsx.fem.kinematics import KINEMATICS, FreeLength, NaturalConfiguration
from remodel_fenicsx.fem.quadrature import Quadrature
from remodel_fenicsx.model.energy import MATRICES, TURNED_OVER, Tissue, mixed
from remodel_fenicsx.model.axes import GROWTH, NATURAL_GRADIENT, LocalAxes
from remodel_fenicsx.results.columns import Observer
from remodel_fenicsx.fem.assembly import agreed
from remodel_fenicsx.scene import Scene, SceneError
from remodel_fenicsx.schema.settings import Cells, Properties, Turnover, in_region
from remodel_fenicsx.state import Snapshot, State, UnitCells, by_region
from remodel_fenicsx.system.files import typed
from remodel_fenicsx.system.interrupts import take_back_signals
from remodel_fenicsx.watch import WATCHERS
from remodel_fenicsx.watch.stability import EquilibriumStability

log = logging.getLogger(__name__)

TIME_ERROR = "time_error"  # the column
Fibres = Mapping[str, Mapping[str, Any]]  # measured: by region and name, a row for each element of the mesh
NO_FIBRES: Fibres = {}
# what files of fibres may have beside the fibres, as it is at the start of a run
UNCHANGED: Mapping[str, Any] = {NATURAL_GRADIENT: np.eye(3), "content": 1.0, "natural_length": 1.0, GROWTH: 1.0}
NEVER_LOCKED = 1e12  # link lengths: contour length of chains that are not there; infinity times zero is no number
BEYOND = 0.5
"""Widths of the innermost layer: points that lie so far inside of a thin wall have rounding for stretches, for
polynomials of degree 24 grow by T_24(1 + 2 BEYOND) = 3e13 up to there."""
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
    control, rest
        Chooses the steps, where the scene has a tolerance; goes on until the cells rest, where its end is that.
    watchers
        Who follows its steps, in their order: the stability of equilibria, the observer, and those of
        `extend.WATCHERS`; what they remember is part of the state.

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
        parts = build(scene, comm, domain, coupling)
        self.scene, self.domain, self.stepper, self.observer = parts.scene, parts.domain, parts.stepper, parts.observer
        self.state, self.control, self.rest = parts.stepper.state, parts.control, parts.rest
        self.unknown, self.cells, self.loading = self.state.unknown, self.state.cells, self.state.loading
        self.quadrature, self.tissue = self.cells.quadrature, self.stepper.tissue
        self.watchers = watchers(self.scene, parts)

    def load_values(self, time: float, case: int = 0) -> LoadValues:
        """Magnitude of every load at a time, in a load case; the first is 0."""
        return values_of_loads(list(self.scene.each_case())[case].loads, time)

    def steps(self, watchers: Sequence[Watcher] = ()) -> Iterator[Step]:
        """Solve and remodel step by step, from where the state is; what is yielded has been accepted.

        The row and the fields belong to the solved state. With the couplings "staggered" and "relaxed" the cells seen
        at a yield are one pass ahead of them (docs/theory.md, Couplings).

        Parameters
        ----------
        watchers
            Who else follows the steps; those who watch the stability and fill each step's row come first.

        Raises
        ------
        StepFailure
            If a step has no admissible equilibrium.
        """
        watchers = [*self.watchers, *watchers]
        if self.rest is not None:
            return self.rest.march(self.scene.last_time, watchers)
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
        for watcher in self.watchers:
            watcher.close()
        self.stepper.close()


@dataclass(frozen=True)
class Parts:
    """What a scene needs: its choices made, the mesh, and who goes through time; the state is the stepper's."""

    scene: Scene
    domain: Domain
    stepper: Stepper
    observer: Observer
    control: Any  # `StepControl`, where there is a tolerance
    rest: Any  # `Homeostasis`, where the way ends at rest


def build(scene: Scene, comm: MPI.Intracomm, domain: Domain | None = None, coupling: Maker | None = None) -> Parts:
    """The parts of a scene in their order. Collective."""
    scene, domain = _meshed(scene, comm, domain)
    fibres = measured_fibres(scene, domain)
    state, *others = _states(scene, domain, fibres)
    if others and coupling is not None:
        raise SceneError("cases: a coupling of your own solves one load case; leave out [[cases]]")
    tissue, kappa = parameters_of(scene.properties(), domain)
    if scene.remodeling.turnover.is_on:
        from remodel_fenicsx.evolution.turnover import turned_over

        tissue, quadrature = turned_over(tissue, state), state.cells.quadrature
        for name in TURNED_OVER:
            quadrature.values(getattr(tissue, name), ())[:] = in_files(fibres, name, quadrature, domain)
    at_once, solver, settings = scene.time.is_equilibrium, scene.solver, scene.remodeling
    if solver.predictor == "with-tolerance" and scene.time.tolerance is None and not at_once:
        solver = solver.model_copy(update={"predictor": "none"})
    if at_once and scene.has_random_cells and scene.jumps_by_rank:  # no step is short enough, and passes swing
        settings = settings.model_copy(update={"coupling": "relaxed"})
        if comm.rank == 0:
            log.info("the path to the equilibrium takes the coupling 'relaxed': random cells swing from rank to rank")
    first, *more = (partial(values_of_loads, case.loads) for case in scene.each_case())
    stepper = Stepper(state, tissue, settings, solver, first, coupling, kappa)
    if settings.turnover.grows:
        stepper.remodeling.turnover.begin_with(in_files(fibres, GROWTH, state.cells.quadrature, domain))
    if others:
        given = enumerate(zip(others, more, strict=True), start=2)
        cases = [OtherCase(number, *part, stepper, solver, kappa) for number, part in given]
        stepper.remodeling.join(cases, [case.weight for case in scene.cases])
    control, rest = None, None
    if at_once:
        rest = _way_to_rest(scene, stepper)
    elif scene.time.tolerance is not None:
        from remodel_fenicsx.evolution.time_steps import StepControl

        control = StepControl(stepper, scene.time.tolerance, scene.time.step, scene.stops())
    elif TIME_ERROR in scene.output.columns:
        from remodel_fenicsx.evolution.time_steps import TimeError

        stepper.judge = TimeError(stepper).measure
    estimated = [TIME_ERROR] if control is not None and TIME_ERROR not in scene.output.columns else []
    observer = Observer(scene.geometry, stepper, scene.columns(estimated))
    return Parts(scene, domain, stepper, observer, control, rest)


def watchers(scene: Scene, parts: Parts) -> list[Watcher]:
    """Who follows the steps, in their order: a row has the eigenvalues, and warnings come after it."""
    stepper, unstable = parts.stepper, scene.solver.unstable
    counted = "negative_eigenvalues" in scene.output.columns
    found = [EquilibriumStability(stepper, unstable, every_step=counted), parts.observer]
    found += [kind.make(scene, stepper) for kind in WATCHERS.values()]
    for case in stepper.remodeling.cases:
        own = [EquilibriumStability(case, unstable)]
        own += [kind.make(scene, case) for kind in WATCHERS.values() if kind.each_case]
        found += [OtherCaseWatcher(case, watcher) for watcher in own if watcher is not None]
    return [watcher for watcher in found if watcher is not None]


def begin_again(simulation: Simulation, start: Snapshot, scene: Scene) -> bool:
    """From its start, with other numbers of tissue, kappa, loads and opening angle of its scene; whether it can."""
    tissue, kappa = parameters_of(scene.properties(), simulation.domain)
    known, stepper, kinematics = simulation.stepper.tissue.parameters, simulation.stepper, simulation.state.kinematics
    varies = {name: isinstance(value, Function) for name, value in tissue.parameters.items()}
    # by who knows numbers
    watched = simulation.control or simulation.rest or kinematics.grows or scene.solver.unstable == "stop"
    if watched or any(varies[name] and not isinstance(known[name], Function) for name in varies):
        return False
    for name, value in tissue.parameters.items():
        numbers = known[name].x.array if isinstance(known[name], Function) else known[name].value
        numbers[...] = value.x.array if varies[name] else value
    stepper.load_values = partial(values_of_loads, scene.loads)
    stepper.remodeling.set_kappa(kappa)
    simulation.state.restore(start)
    if isinstance(kinematics, NaturalConfiguration) and not scene.natural.fibres:
        cells, quadrature = simulation.cells, simulation.quadrature
        values, kinematics.closing = natural_gradient(scene, quadrature, simulation.domain, cells.local_axes)
        quadrature.values(kinematics.gradient, (3, 3))[:] = values
    simulation.scene = scene
    return True


# ---------------------------------------------------------------- parts, in their order


def _meshed(scene: Scene, comm: MPI.Intracomm, domain: Domain | None) -> tuple[Scene, Domain]:
    """The scene with its choices made, which are said, and the mesh."""
    if scene.geometry.is_loaded:
        raise SceneError(
            f"geometry.is = 'loaded': the unloaded body is needed; {typed()} unload SCENE writes its scene"
        )
    if domain is None and comm.rank == 0:
        for line in explained(scene) if scene.model.kinematics == AUTO else only_for_means(scene):
            log.info("%s", line)
    if scene.mesh.formulation == AUTO and comm.rank == 0:
        log.info("%s", scene.formulation_in_words())
    scene = with_choices(scene, domain)
    return scene, checked_domain(mesh_of(scene, comm) if domain is None else domain, scene)


def _states(scene: Scene, domain: Domain, fibres: Fibres) -> list[State]:
    """One for each load case; made in the order of those of the first, so that all have the same kernels."""
    made = [on_mesh_alone(scene, domain) for _ in scene.each_case()]
    unknowns = [one.unknown(domain.mesh, scene.mesh.degree) for one in made]
    quadrature = Quadrature(domain.mesh, scene.mesh.degree, made[0].weight(domain.mesh))
    properties, local_axes = scene.properties(), scene.geometry.local_axes(domain, quadrature)
    own = {name: properties[name].cells for name in scene.regions}
    grows = scene.remodeling.turnover.grows
    if grows or not scene.natural.is_of_the_mesh:
        values, closed = np.eye(3), None
        if not scene.natural.is_of_the_mesh:
            values, closed = natural_gradient(scene, quadrature, domain, local_axes, fibres)
        present, initial = (quadrature.function(f"{name}_gradient", (3, 3)) for name in ("natural", "initial"))
        for function in (present, initial):
            quadrature.values(function, (3, 3))[:] = values
        made = [NaturalConfiguration(one, present, closed, initial if grows else None) for one in made]
    cells = UnitCells(quadrature, domain, scene.cells, local_axes, own, fibres)
    if scene.natural.fibres and quadrature.shape[1] > 1:
        tensors = quadrature.owned(cells.structure_tensor()).reshape(-1, quadrature.shape[1], 9)
        between = np.sqrt(quadrature.maximum(quadrature.jumps(tensors / np.square(scene.cells.end_to_end_length))))
        if domain.comm.rank == 0:
            log.info(
                "natural.fibres: files have the mean of each element, and the first row is off by what varies inside "
                "them: elements differ from their neighbours by up to %.1f %% of tr A",
                100 * between,
            )
    return [unloaded_state(scene, u, k, cells, domain) for u, k in zip(unknowns, made, strict=True)]


def _way_to_rest(scene: Scene, stepper: Stepper) -> Any:
    """What goes with the stepper until the cells rest."""
    from remodel_fenicsx.evolution import homeostasis
    from remodel_fenicsx.evolution.time_steps import StepControl

    stops, tolerance = scene.stops(), scene.time.tolerance
    if tolerance is None:
        falls = any(load.falls for load in scene.loads.values())
        tolerance = homeostasis.UNLOADING if falls else homeostasis.PATH_TOLERANCE
    if scene.has_random_cells and scene.jumps_by_rank:
        tolerance = homeostasis.UNCHECKED
    control = StepControl(stepper, tolerance, scene.time.step, stops, homeostasis.LONGEST)
    first = scene.last_hold if scene.remodeling.turnover.starts_at_rest else None
    return homeostasis.Homeostasis(control, max(stops[:-1], default=0.0), first)


def on_mesh_alone(scene: Scene, domain: Domain) -> Any:
    """The scene's kinematics, of a mesh that is free of stress."""
    kinematics = KINEMATICS[scene.model.kinematics].on(domain.mesh, scene.geometry)
    return FreeLength(kinematics, scene.geometry) if scene.has_free_length else kinematics


def unloaded_state(scene: Scene, unknown: Any, kinematics: Any, cells: UnitCells, domain: Domain) -> State:
    """Unknowns of the body with its supports, and with loads that are zero."""
    shape, loading = scene.geometry, Loading(domain, unknown, kinematics)
    shape.support(loading, scene.supports.ends, scene.loads)
    matrices = [one.material for one in scene.properties().values()]
    modulus = max(material.lame_lambda + 2 * material.lame_mu for material in matrices)
    shape.hold_faces(loading, scene.supports.faces, modulus, scene.loads)
    return State(unknown, kinematics, cells, loading, FORMULATIONS[scene.mesh.formulation])


def natural_gradient(
    scene: Scene, quadrature: Quadrature, domain: Domain, local_axes: LocalAxes, fibres: Fibres = NO_FIBRES
) -> tuple[Any, Any]:
    """G (elements, points, 3, 3) of a body whose tissue is free of stress elsewhere; what closes to it, if anything."""
    from remodel_fenicsx.body.wall import gradient, prestretch
    from remodel_fenicsx.model.residual_stress import closing

    natural, shape, found = scene.natural, scene.geometry, None
    if natural.fibres:
        present, ratio = (in_files(fibres, name, quadrature, domain) for name in (NATURAL_GRADIENT, GROWTH))
        across = np.einsum("...j,...k->...jk", *(2 * [local_axes.axes[..., 2, :]]))
        return present @ (np.eye(3) + (ratio - 1.0)[..., None, None] * across), None  # G_0 of `evolution.turnover`
    for index, layer in enumerate(natural.layers):
        if layer.region is not None and layer.region not in domain.regions:
            known = ", ".join(map(repr, domain.regions))
            raise SceneError(f"natural.layers[{index}].region = {layer.region!r}: no such region; there are {known}")
    if isinstance(shape, RoundWall):
        tissues = {name: properties.tissue for name, properties in scene.properties().items()}
        try:
            found = closing(shape.layers_of_tissue(natural, scene.regions, tissues), natural.opening_angle)
        except ArithmeticError as error:
            asked = f"natural.opening_angle = {natural.opening_angle:g}"
            raise SceneError(f"{asked}: must be smaller, or natural.layers nearer to 1: {error}") from error
        radii, (inner, next_one, *_) = np.linalg.norm(local_axes.coordinates[..., :2], axis=-1), found.panels.edges
        stretches = found.stretches(radii)
        beyond = quadrature.maximum(((inner - radii) / (next_one - inner)).reshape(quadrature.shape))
        if beyond > BEYOND or quadrature.minimum(stretches.min(axis=-1).reshape(quadrature.shape)) <= 0:
            rule = "must be smaller, or mesh.refinement larger: the sides of elements are chords that leave the wall"
            raise SceneError(f"natural.opening_angle = {natural.opening_angle:g}: {rule}")
    else:
        stretches = prestretch(natural, local_axes, domain)
    return gradient(stretches, local_axes.axes).reshape(*quadrature.shape, 3, 3), found


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
            measured = _fibres_of(cells, name, points[elements], chosen)
            found[name] = _with_prestretch(measured, f"{in_region(name)}cells.fibres = {cells.fibres!r}", scene)
        return found

    return domain.comm.bcast(agreed(domain.comm, read)) or {}


def _with_prestretch(measured: dict[str, Any], key: str, scene: Scene) -> dict[str, Any]:
    """Measured fibres, with prestretch, content and natural length where the scene begins with those of the file."""
    wanted, held = scene.natural.fibres, [name for name in UNCHANGED if name in measured]
    changed = [name for name in held if not np.allclose(measured[name], np.reshape(UNCHANGED[name], -1))]
    if changed and wanted is None:
        rule = "set natural.fibres = true to begin with them, or false to leave them out"
        raise SceneError(f"{key}: has {', '.join(changed)} of an earlier run; {rule}")
    of_turnover = [name for name in TURNED_OVER if name in changed]
    if wanted and of_turnover and not scene.remodeling.turnover.is_on:
        raise SceneError(f"{key}: has {' and '.join(of_turnover)}, which only remodeling.turnover knows; it is not set")
    if wanted and GROWTH in changed:
        _check_growth(measured[GROWTH], key, scene.remodeling.turnover)
    return {name: values for name, values in measured.items() if wanted or name not in held}


def _check_growth(growth: Any, key: str, turnover: Turnover) -> None:
    """Whether tissue that has grown in an earlier run can go on as the scene says."""
    if turnover.start:
        raise SceneError(f"{key}: has {GROWTH} of an earlier run; remodeling.turnover.from must be 0 with it")
    if growth.min() <= 1.0 - turnover.volume:
        volume = f"remodeling.turnover.volume must be above {1.0 - growth.min():.3g} with it"
        raise SceneError(f"{key}: has {GROWTH} of an earlier run, {growth.min():.3g} at the least; {volume}")


def in_files(fibres: Fibres, name: str, quadrature: Quadrature, domain: Domain) -> Any:
    """An array of files of fibres at the points, (elements, points, ...); `UNCHANGED` where they have none."""
    plain = np.asarray(UNCHANGED[name])
    found = np.tile(plain, (*quadrature.shape, *(1 for _ in plain.shape)))
    for region, measured in fibres.items():
        if name in measured:
            chosen = domain.element_region == domain.regions[region] if region else np.ones(len(found), dtype=np.bool_)
            found[chosen] = measured[name][domain.element_number[chosen]].reshape(-1, 1, *plain.shape)
    return found


def _fibre_file(cells: Cells, region: str) -> Any:
    from remodel_fenicsx.body.fibres import read_fibre_file  # few scenes have one

    try:
        file = read_fibre_file(Path(str(cells.fibres)))
        if cells.fibres_sha256 not in (None, file.sha256):
            raise UnreadableFile(f"has changed: its SHA-256 was {str(cells.fibres_sha256)[:12]}...")
    except UnreadableFile as error:
        raise SceneError(f"{in_region(region)}cells.fibres = {cells.fibres!r}: {error}") from error
    return file


def _fibres_of(cells: Cells, region: str, corners: Any, chosen: Any) -> dict[str, Any]:
    key, file = f"{in_region(region)}cells.fibres", _fibre_file(cells, region)
    try:
        rows, farthest = file.rows_of(corners, chosen)
    except UnreadableFile as error:
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
    domain = checked_domain(mesh_of(scene, MPI.COMM_SELF), scene)
    scene.geometry.check_faces(domain, scene.supports.faces, scene.loads)
    measured_fibres(scene, domain)
    return ""


def parameters_of(properties: Mapping[str, Properties], domain: Domain) -> tuple[Tissue, Any]:
    """Tissue and kappa of a scene's regions: numbers where these agree, DG0 Functions where they differ."""
    tissues, kappas = _tissues(properties), {name: one.kappa for name, one in properties.items()}
    tissue, kappa = next(iter(tissues.values())), next(iter(kappas.values()))
    if any(other != tissue for other in tissues.values()):
        tissue = tissue.map(lambda key, _: by_region(domain, {name: t.parameters[key] for name, t in tissues.items()}))
    return tissue, kappa if len(set(kappas.values())) == 1 else by_region(domain, kappas)


def _tissues(properties: Mapping[str, Properties]) -> dict[str, Tissue]:
    """Of the regions, all of one chain law and one matrix: where there are no chains, none locks."""
    found = {name: one.tissue for name, one in properties.items()}
    chain = next((tissue.chain for tissue in found.values() if tissue.chain is not None), None)
    matrices = list(dict.fromkeys(one.material.matrix for one in properties.values()))
    for name, tissue in found.items():
        if chain is not None and tissue.chain is None:
            length = NEVER_LOCKED if chain.locks else tissue.contour_length
            found[name] = replace(tissue, chain=chain, contour_length=length)
    return found if len(matrices) == 1 else _with_one_matrix(found, properties, matrices)


def _with_one_matrix(
    tissues: Mapping[str, Tissue], properties: Mapping[str, Properties], matrices: Sequence[str]
) -> dict[str, Tissue]:
    mixture = mixed([MATRICES[name] for name in matrices])  # type: ignore[misc]  # `rules.tissue_of_regions` asks
    defaults = {name: number.default for name, number in mixture.parameters.items()}
    found = {}
    for name, tissue in tissues.items():
        share = {f"share_{matrices.index(properties[name].material.matrix)}": 1.0}
        own = getattr(tissue.matrix, "values", {})
        found[name] = replace(tissue, matrix=mixture.of({**defaults, **own, **share}))
    return found


def with_choices(scene: Scene, domain: Domain | None = None) -> Scene:
    """The scene with what it is run with where it leaves the choice. A mesh of one's own is full."""
    if AUTO not in (scene.model.kinematics, scene.mesh.formulation):
        return scene
    name = choice(scene).name if domain is None or scene.model.kinematics != AUTO else "full"
    return scene.with_values({"model.kinematics": name, "mesh.formulation": scene.formulation})


def mesh_of(scene: Scene, comm: MPI.Intracomm) -> Domain:
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
    if isinstance(shape, RoundWall) and scene.regions and (others := set(domain.regions) - set(scene.regions)):
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
